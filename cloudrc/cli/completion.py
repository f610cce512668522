"""`cloudrc completion SHELL`: print a script that completes command lines on the Tab key.

The script contains all commands, options and shipped names. Therefore completion does not have to
start Python.
"""

from __future__ import annotations

import argparse
import importlib.util
from collections.abc import Iterator, Sequence
from typing import Any

from cloudrc.cli.output import STDOUT
from cloudrc.errors import MissingPrerequisiteError
from cloudrc.files import naming

EPILOG = """\
installation:
  cloudrc completion bash > ~/.local/share/bash-completion/completions/cloudrc
  cloudrc completion zsh > ~/.zfunc/_cloudrc     (~/.zfunc must be in $fpath)
  cloudrc completion fish > ~/.config/fish/completions/cloudrc.fish"""

JOINED = """\
# Bash splits words at "=": join KEY=VALUE before completing, and return what follows "=".
_cloudrc_joined() {
  local word joined=()
  for word in "${COMP_WORDS[@]:0:COMP_CWORD+1}"; do
    if [[ ${#joined[@]} -gt 0 && ( $word == "=" || ${joined[-1]} == *= ) ]]; then
      joined[-1]+=$word
    else
      joined+=("$word")
    fi
  done
  local COMP_WORDS=("${joined[@]}") COMP_CWORD=$(( ${#joined[@]} - 1 ))
  word=${joined[-1]}
  _shtab_cloudrc "$1" "$word" "$3"
  [[ $word == *=* ]] && COMPREPLY=("${COMPREPLY[@]#*=}")
  [[ ${COMPREPLY[0]-} == *= ]] && compopt -o nospace 2>/dev/null
}
complete -o bashdefault -F _cloudrc_joined cloudrc
"""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), help="your shell")


def execute(options: argparse.Namespace) -> int:
    """Print the completion script for the given shell."""
    if importlib.util.find_spec("shtab") is None:
        raise MissingPrerequisiteError(
            "completion needs shtab, which is not installed; run: pip install shtab"
        )
    import shtab

    from cloudrc.cli.parser import COMMANDS, build_parser
    from cloudrc.config import shipped
    from cloudrc.runs.catalogue import settings

    keys = list(settings())
    of_link = [key.removeprefix("link.") for key in keys if key.startswith("link.")]
    candidates = {
        "EXPERIMENT": _candidates("experiment", shipped.names("experiment"), files=True),
        "PROFILE": _candidates("profile", shipped.names("profile"), files=True),
        "KEY=VALUE of --set": _candidates("key", keys),
        "KEY=VALUE": _candidates("link", of_link),  # the arguments of `link set`
        **dict.fromkeys("AB", _candidates("key", keys)),  # the arguments of `compare`
    }
    parser = build_parser(COMMANDS, for_completion=True)
    for action in _actions(parser):
        name = " of ".join([str(action.metavar), *action.option_strings])
        if found := candidates.get(name) or candidates.get(str(action.metavar)):
            action.complete = found  # type: ignore[attr-defined]
    with naming(STDOUT):
        print(shtab.complete(parser, options.shell))
    if options.shell == "bash":
        print(JOINED)
    return 0


def _actions(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    for action in parser._actions:
        yield action
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _actions(command)


def _candidates(name: str, words: Sequence[str], *, files: bool = False) -> dict[str, Any]:
    """Make the code that completes `words` in each shell, in the form that package shtab needs.

    `name` becomes part of the name of a shell function. If `files` is True, the code also completes
    paths of files.
    """
    function, joined = f"_cloudrc_{name}", " ".join(words)
    bash = zsh = fish = ""
    if files:
        bash, zsh = "; compgen -f -- $1", "; _files -g '*.yaml'"
        fish = " (__fish_complete_suffix .yaml)"
    return {
        "bash": function,
        "zsh": function,
        "fish": joined + fish,
        "preamble": {
            "bash": f"{function}() {{ compgen -W '{joined}' -- $1{bash}; }}\n",
            "zsh": f"{function}() {{ compadd -S '' -- {joined}{zsh} }}\n",
        },
    }
