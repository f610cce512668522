"""`cloudrc completion SHELL`: print a static script, so that Tab starts no Python."""

from __future__ import annotations

import argparse
import importlib.util

from cloudrc.errors import MissingPrerequisiteError

SHELLS = ("bash", "zsh", "fish")
EPILOG = """\
installation:
  cloudrc completion bash > ~/.local/share/bash-completion/completions/cloudrc
  cloudrc completion zsh > ~/.zfunc/_cloudrc     (~/.zfunc must be in $fpath)
  cloudrc completion fish > ~/.config/fish/completions/cloudrc.fish"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("shell", choices=SHELLS, help="your shell")


def execute(options: argparse.Namespace) -> int:
    """Print the script."""
    if importlib.util.find_spec("shtab") is None:
        raise MissingPrerequisiteError(
            "completion needs shtab, which is not installed; run: pip install shtab"
        )
    import shtab

    from cloudrc.cli.parser import COMMANDS, build_parser

    print(shtab.complete(build_parser(COMMANDS, for_completion=True), options.shell))
    return 0
