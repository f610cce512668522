# SPDX-License-Identifier: Apache-2.0

"""Build the parser of the command line from a table of commands and their help lines."""

from __future__ import annotations

import argparse
import importlib
import re
import sys
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any, NoReturn, Protocol, TypeVar

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.values import InvalidValueError, Quantity
from cloudrc.base.text import suggest_name, unknown_name_text
from cloudrc.version import __version__

GROUPS: dict[str, dict[str, str]] = {
    "fly and steer": {
        "run": "fly an experiment and write its report",
        "up": "start a session: it waits for missions, until Ctrl-C or 'down'",
        "down": "end the session; it writes the report of its last mission",
        "mission": "start, steer and stop missions, here or in a cluster",
        "console": "show a flight in the browser, and steer it there",
        "ros": "show a flight to nodes of ROS 2, which may steer it",
        "replay": "watch a recorded flight in 3-D, in a browser",
        "report": "write the report of a recorded run again, or recover a recording",
        "timeline": "show where the age of the commands comes from, stage by stage",
        "see": "let a perception look again at what a recorded flight saw",
    },
    "links": {
        "link": "show, record, verify, change or use the emulated network",
    },
    "studies": {
        "compare": "say whether a setting differs from another, and how sure that is",
        "margin": "find the delay, or other value, up to which the loop is stable",
        "sweep": "fly a grid of settings with several seeds, on all cores",
        "capacity": "find how many robots a radio cell and a cloud carry",
        "place": "find out where the controller should run: robot, edge or cloud",
        "measure": "measure how long a controller computes",
        "identify": "fit the model of the velocity loop to a recorded flight",
        "reproduce": "put the statements of the paper beside what is measured here",
        "bench": "measure how fast the simulation runs here",
    },
    "policies": {
        "eval": "measure whether a policy survives a network",
        "rank": "rank policies over networks, with tasks and links that are fixed",
        "policy": "serve a policy that controls robots elsewhere",
    },
    "cluster": {
        "key": "make or replace the key that world and cloud share",
    },
    "class": {
        "class": "hand out and score the exercise for students",
    },
    "set up": {
        "doctor": "check whether this machine can fly; say what to fix",
        "list": "list experiments, profiles, predictors and more",
        "new": "write a robot or a plug-in of your own that flies, and its test",
        "check": "check a robot or a plug-in: its contract, and a flight",
        "completion": "print a completion script for your shell",
    },
}
"""Group of commands -> command -> help line. `<command>.py` beside this file contains it."""
MODULES = {
    **dict.fromkeys(("up", "down"), "session"),
    "class": "exercise",
}
"""Command -> the module in `cloudrc/doors/cli` that contains it, if the module has another name."""
UNLISTED = {"process": "run one process of a flight: world, cloud, teleop or cell"}
"""Commands that the chart and a flight type, so that the list of `--help` leaves them out."""
COMMANDS = {name: line for group in [*GROUPS.values(), UNLISTED] for name, line in group.items()}
"""Command -> help line."""
KUBECTL_PLUGIN = "kubectl-cloudrc"
"""Name of this program when kubectl starts it as a plug-in."""
COUNT_MAX = 10_000
"""Largest number of repeats, seeds or processes that a flag accepts."""
FLIGHTS_MAX = 100_000
"""Default limit of flights: a sweep is a product, and one axis too many is hours of work."""

ABOUT = "Control a simulated robot from a simulated cloud, over an emulated network."
EXAMPLES = """\
examples:
  cloudrc run                          the paper's mission in real time
  cloudrc run --mode virtual           the same in virtual time, within seconds
  cloudrc run steps --mode virtual --seeds 10 --set cloud.predictor=last_sample
  cloudrc list predictors
  cloudrc run --help                   every command has its own help

exit codes: 0 done, 1 mission failed its criteria, 2 usage or bad input,
  3 missing prerequisite, 4 timeout, 5 cluster, API, outside controller
  or policy failed, 6 run invalid (not real time, a process died),
  70 internal error, 130 interrupted"""


Settings = TypeVar("Settings")
Options = argparse.Namespace
"""What the user has given: an attribute per argument."""


class Arguments(Protocol):
    """What takes arguments: a parser, or a group of its arguments."""

    def add_argument(self, *names: str, **given: Any) -> argparse.Action:
        """Declare an argument."""
        ...


class Parser(argparse.ArgumentParser):
    """Parse a command line; raise errors as BadInputError, which `main` prints in one line.

    Attributes:
        declared: The arguments, also those of groups.
        verbs: Verb, or command, -> its parser.
    """

    def __init__(self, **given: Any) -> None:
        """Take the arguments of argparse; declare `--debug`, which every command and verb has."""
        self.declared: list[argparse.Action] = []
        self.verbs: Mapping[str, Parser] = {}
        form = partial(argparse.RawDescriptionHelpFormatter, max_help_position=26, width=80)
        super().__init__(formatter_class=form, allow_abbrev=False, **given)
        about = "show the traceback of an error"
        self.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=about)

    def error(self, message: str) -> NoReturn:
        """Raise an error with the message of argparse and the command that prints the help."""
        raise BadInputError(f"{message}; see '{self.prog} --help'")

    def add_argument(self, *names: Any, **given: Any) -> argparse.Action:
        """Declare an argument; an error of its `choices` suggests the most similar one."""
        return self._declare(super().add_argument, *names, **given)

    def add_argument_group(self, *about: Any, **given: Any) -> Any:
        """Begin a group of arguments."""
        return self._noted(super().add_argument_group(*about, **given))

    def add_mutually_exclusive_group(self, **given: Any) -> Any:
        """Begin a group of arguments that exclude each other."""
        return self._noted(super().add_mutually_exclusive_group(**given))

    def _noted(self, group: Any) -> Any:
        """Let `declared` have the arguments of a group, too."""
        group.add_argument = partial(self._declare, group.add_argument)
        return group

    def _declare(
        self, add_argument: Callable[..., argparse.Action], *names: str, **given: Any
    ) -> argparse.Action:
        if "choices" in given:
            given["type"] = _one_of([*given["choices"]])
        self.declared.append(add_argument(*names, **given))
        return self.declared[-1]

    def add_subparsers(self, **given: Any) -> Any:
        """Begin the verbs, or the commands."""
        action: Any = super().add_subparsers(**given)
        self.declared.append(action)
        self.verbs = action.choices
        return action

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Refuse unknown arguments here: argparse would name the help of the first command."""
        first = next((word for word in args or () if word != "--debug"), "-")
        if self.verbs and not first.startswith("-") and first not in self.verbs:
            text = unknown_name_text("choice", first, [*self.verbs])
            self.error(str(argparse.ArgumentError(self.declared[-1], text)))
        known, unknown = super().parse_known_args(args, namespace)
        if unknown:
            names = [name for action in self.declared for name in action.option_strings]
            hint = suggest_name(unknown[0], names)
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return known, unknown


@dataclass(frozen=True)
class NumberFlag:
    """A type for argparse: a number."""

    quantity: Quantity

    def __call__(self, text: str) -> Any:
        """Read a number; raise argparse's error for anything else."""
        try:
            return self.quantity.read(text)
        except InvalidValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from None


def whole_number(low: int, high: int) -> NumberFlag:
    """Return a type for argparse: a whole number from `low` to `high`."""
    return NumberFlag(Quantity(ge=low, le=high, whole=True))


read_count, read_seed = whole_number(1, COUNT_MAX), whole_number(0, 2**53 - 1)


def number(low: float, high: float, unit: str) -> NumberFlag:
    """Return a type for argparse: a number from `low` to `high` [`unit`], such as "seconds"."""
    return NumberFlag(Quantity(unit, low, high))


def _one_of(choices: list[str]) -> Callable[[str], str]:
    """Return a type for argparse: a choice; its error suggests the most similar one."""

    def read(text: str) -> str:
        if text not in choices:
            raise argparse.ArgumentTypeError(unknown_name_text("choice", text, choices))
        return text

    return read


def read_list(read: Callable[[str], Any]) -> Callable[[str], tuple[Any, ...]]:
    """Return a function that reads different values between commas, each by `read`."""
    return lambda text: tuple(dict.fromkeys(read(each.strip()) for each in text.split(",")))


def read_size(text: str) -> float:
    """Parse a size in the notation of Kubernetes, such as 500M, for argparse; return bytes."""
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([kKMGT]?)(i?)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' is not a size such as 500M or 1Gi")
    number, unit, binary = found.groups()
    power = " KMGT".index(unit.upper() or " ")
    return float(number) * (1024.0 if binary else 1000.0) ** power


def set_argument(parser: Arguments) -> None:
    """Declare `--set`, which changes keys of the experiment."""
    about = "change one key of the experiment; repeatable"
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=about)


def figure_arguments(parser: Parser, width: float) -> None:
    """Declare the arguments for the size of figures; `width` is the default width [in]."""
    about = f"width of figures in inches: one column of a paper has 3.5 (default: {width})"
    inches = number(2, 20, "inches")
    parser.add_argument("--width", type=inches, default=width, metavar="IN", help=about)
    about = "size of the text of figures in points (default: 9)"
    points = number(5, 24, "points")
    parser.add_argument("--font-size", type=points, default=9.0, metavar="PT", help=about)


class _Version(argparse.Action):
    """Print the version and the hash of the code, which is computed only if it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from cloudrc.base.source import code_hash

        print(f"cloudrc {__version__} (code {code_hash()})")
        parser.exit()


def build_parser(wanted: Container[str]) -> Parser:
    """Build the parser of the `wanted` commands; if none is one of ours, of all, without arguments.

    The function imports only the modules of these commands.
    """
    # kubectl starts a plug-in by its file name, which nobody types.
    typed = "kubectl cloudrc" if Path(sys.argv[0]).name == KUBECTL_PLUGIN else "cloudrc"
    groups = []
    for title, lines in GROUPS.items():
        named = [f"  {name:<12}{line}" for name, line in lines.items()]
        groups.append("\n".join([f"{title}:", *named]))
    parser = Parser(
        prog=typed,
        usage=f"{typed} [-h] [--version] [--debug] COMMAND ...",
        description="\n\n".join([ABOUT, *groups]),
        epilog=EXAMPLES,
    )
    about = "print version and hash of the code"
    parser.add_argument("--version", action=_Version, nargs=0, help=about)
    commands = parser.add_subparsers(dest="command", help=argparse.SUPPRESS, prog=typed)
    chosen = {name: line for name, line in COMMANDS.items() if name in wanted}
    for name, line in (chosen or COMMANDS).items():
        command = commands.add_parser(name, help=line, description=_sentence(line))
        if name in wanted:
            module = _find_command(name)
            command.epilog = getattr(module, "EPILOG", None)
            module.arguments(command)
            command.set_defaults(execute=getattr(module, "execute", None))
    return parser


def settings_from(options: Options, kind: Callable[..., Settings]) -> Settings:
    """Make a dataclass from the flags with the names of its fields."""
    names = [field.name for field in fields(kind)]  # type: ignore[arg-type]
    return kind(**{name: getattr(options, name) for name in names})


def add_verbs(parser: Parser, lines: Mapping[str, str]) -> dict[str, Parser]:
    """Declare the verbs of a command; `lines` maps each verb to its line in the help.

    Return verb -> its parser. When the command runs, `options.verb` is the user's choice.
    """
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB", title="verbs")
    return {
        name: verbs.add_parser(name, help=line, description=_sentence(line))
        for name, line in lines.items()
    }


def _sentence(line: str) -> str:
    return f"{line[0].upper()}{line[1:]}."


def _find_command(name: str) -> Any:
    """Return what has the functions `arguments` and `execute` of a command.

    `execute` gets the `Options`, and returns the exit code; None means 0. Verbs may have their own.
    """
    module = importlib.import_module(f"cloudrc.doors.cli.{MODULES.get(name, name)}")
    return getattr(module, name, module) if name in MODULES else module
