# SPDX-License-Identifier: Apache-2.0

"""`cloudrc completion SHELL`: print a script that completes command lines on the Tab key.

Package shtab writes the script. It contains all commands, options and shipped names, so completion
does not have to start Python.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator

from cloudrc.doors.cli.parser import Options, Parser

EPILOG = """\
installation:
  cloudrc completion bash > ~/.local/share/bash-completion/completions/cloudrc
  cloudrc completion zsh > ~/.zfunc/_cloudrc     (~/.zfunc must be in $fpath)
  cloudrc completion fish > ~/.config/fish/completions/cloudrc.fish"""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="your shell")


def execute(options: Options) -> None:
    """Print the completion script for the given shell."""
    import shtab

    from cloudrc.config import shipped
    from cloudrc.doors.catalogue import settings
    from cloudrc.doors.cli.parser import COMMANDS, build_parser

    keys = list(settings())
    of_link = [key.removeprefix("link.") for key in keys if key.startswith("link.")]
    words = {
        "EXPERIMENT": shipped.names("experiment"),
        "PROFILE": shipped.names("profile"),
        "KEY=VALUE of --set": keys,
        "KEY=VALUE": of_link,  # the arguments of `link set`
        **dict.fromkeys("AB", keys),  # the arguments of `compare`
    }
    parser = build_parser(COMMANDS)
    for action in _actions(parser):
        name = " of ".join([str(action.metavar), *action.option_strings])
        action.choices = words.get(name) or words.get(str(action.metavar)) or action.choices
    print(shtab.complete(parser, options.shell))


def _actions(parser: Parser) -> Iterator[argparse.Action]:
    yield from parser.declared
    if parser.verbs:
        parser.declared[-1].help = "what to do"  # without it, shtab leaves the commands out
        for command in parser.verbs.values():
            yield from _actions(command)
