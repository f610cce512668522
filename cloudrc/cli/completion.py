"""`cloudrc completion SHELL`: print a script that completes command lines on the Tab key.

The script contains all commands, options and shipped names. Therefore completion does not have to
start Python.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
from collections.abc import Iterator, Sequence
from typing import Any

from cloudrc.cli.output import STDOUT
from cloudrc.errors import CloudrcError, MissingPrerequisiteError
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

    keys = list(_settings())
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


def _settings() -> Iterator[str]:
    """Yield the completions of `--set`: KEY=NAME if the key accepts names, KEY= if it does not."""
    from cloudrc import plugins
    from cloudrc.config import problems, shipped
    from cloudrc.config.overrides import KINDS, parameter_names
    from cloudrc.config.schema import Experiment

    named = {f"cloud.{key}": plugins.names(kind) for key, kind in KINDS.items()}
    named |= {"link.profile": shipped.names("profile"), "mission": shipped.names("mission")}
    named |= {f"world.{kind}": shipped.names(kind) for kind in ("robot", "scene")}
    keys = {".".join(path) for path, _ in problems.leaves(Experiment) if "0" not in path}
    for key, kind in KINDS.items():
        for name in named[f"cloud.{key}"]:
            keys |= {f"cloud.{key}.{parameter}" for parameter in parameter_names(kind, name)}
    of_robots, named["world.tuning"] = _of_robots()
    keys |= of_robots
    keys |= {key.replace("uplink", "both") for key in keys if key.startswith("link.uplink.")}
    yield from (f"{key}=" for key in sorted(keys - set(named)) if not key.endswith(".name"))
    yield from sorted(f"{key}={name}" for key, names in named.items() for name in names)


def _of_robots() -> tuple[set[str], list[str]]:
    """Return the keys of the onboard controllers of shipped robots, and the names of tunings."""
    from cloudrc.config import shipped
    from cloudrc.config.overrides import default_parameters
    from cloudrc.config.robot import find_robot

    keys, tunings = set[str](), set[str]()
    for robot in map(find_robot, shipped.names("robot")):
        tunings |= robot.tunings.keys()
        with contextlib.suppress(
            CloudrcError
        ):  # without MuJoCo, some controllers have no signature
            assert robot.onboard is not None
            keys |= default_parameters("onboard", robot.onboard.name).keys()
    return {f"world.onboard.{key}" for key in keys}, sorted(tunings)


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
