"""`cloudrc faults`: what goes wrong is brought about on purpose, what has to follow is checked."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from cloudrc.cli.cluster_flags import place_arguments
from cloudrc.cli.extras import require
from cloudrc.cli.output import output_argument
from cloudrc.cli.parser import COUNT_MAX, count, read_from
from cloudrc.errors import BadInputError

EPILOG = """\
examples:
  cloudrc faults list                        of all three modes
  cloudrc faults run cloud-killed            or its number: F13
  cloudrc faults run --all --seed 2 --junit faults.xml
  cloudrc faults run --all --real            with processes, signals and sockets
  cloudrc faults fuzz --seeds 200 --jobs 2   random compositions, invariants
  cloudrc faults fuzz --seeds 200 --adversarial
  cloudrc faults fuzz --first 201 --seeds 200

exit codes: 0 no check failed, 1 one did, 2 bad input,
  3 or 5 no cluster or no release there (--cluster),
  6 a worker was killed, 130 interrupted"""
JOBS = "at once, one a core at most (default: 1)"
SEED_MAX = 2**53 - 1 - COUNT_MAX
"""Of the first one: an experiment takes those counted from it, too, which are below 2^53."""
ACTIONS = {
    "list": "all faults, what is done and what has to follow",
    "run": "bring faults about and check what follows",
    "fuzz": "compose faults at random, look at the invariants in every step",
    "replay": "fly a stored schedule again",
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions")
    parsers = {}
    for name, text in ACTIONS.items():
        sub = actions.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        parsers[name] = sub
        output_argument(sub)
    _modes(parsers["list"])
    _run_arguments(parsers["run"])
    _fuzz_arguments(parsers["fuzz"])
    parsers["replay"].add_argument(
        "file", type=read_from, metavar="FILE", help="a schedule (.yaml)"
    )


def seed(text: str) -> int:
    """Read the seed of a generator of chance, as argparse calls it."""
    if not text.isdecimal() or int(text) > SEED_MAX:
        raise argparse.ArgumentTypeError(f"'{text}' is not a whole number from 0 to {SEED_MAX}")
    return int(text)


def written_to(text: str) -> Path:
    """Read the name of a file that is written at the end: said now, if that cannot be."""
    path = Path(text)
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise argparse.ArgumentTypeError(f"{text}: no file can be written there")
    return path


def folder(text: str) -> Path:
    """Read the name of a folder that is made when something is found: said now, if it cannot be."""
    path = Path(text)
    there = next(each for each in (path, *path.absolute().parents) if each.exists())
    if not (there.is_dir() and os.access(there, os.W_OK)):
        raise argparse.ArgumentTypeError(f"{text}: no folder can be made there")
    return path


def _modes(parser: argparse.ArgumentParser) -> None:
    mode = parser.add_mutually_exclusive_group()
    text = "with real processes, signals and sockets on this machine"
    mode.add_argument("--real", action="store_true", help=text)
    text = "on a release in a cluster; F38 rotates its key"
    mode.add_argument("--cluster", action="store_true", help=text)


def _run_arguments(parser: argparse.ArgumentParser) -> None:
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("name", nargs="?", metavar="NAME", help="of the fault, or its number: F13")
    what.add_argument("--all", action="store_true", help="every fault of the mode")
    _modes(parser)
    parser.add_argument("--seed", type=seed, default=1, metavar="N", help="default: 1")
    parser.add_argument("--jobs", type=count, default=1, metavar="J", help=JOBS)
    parser.add_argument(
        "--junit", type=written_to, metavar="FILE", help="write the results as JUnit"
    )
    text = "write the result as a page of Markdown; with --all"
    parser.add_argument("--document", type=written_to, metavar="FILE", help=text)
    place_arguments(parser)


def _fuzz_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seeds", type=count, default=200, metavar="N", help="default: 200")
    parser.add_argument("--first", type=seed, default=1, metavar="N", help="default: 1")
    parser.add_argument("--jobs", type=count, default=1, metavar="J", help=JOBS)
    kind = parser.add_mutually_exclusive_group()
    kind.add_argument(
        "--adversarial", action="store_true", help="the cloud holds valid keys and wants a breach"
    )
    kind.add_argument(
        "--clean", action="store_true", help="nothing goes wrong: any HOLD is a false alarm"
    )
    text = "write the result as a page of Markdown"
    parser.add_argument("--document", type=written_to, metavar="FILE", help=text)
    parser.add_argument(
        "--store",
        type=folder,
        default=Path("faults-found"),
        metavar="DIR",
        help="where a failing schedule is kept, once it is shrunk (default: ./faults-found)",
    )


def execute(options: argparse.Namespace) -> int:
    """Do what the action says."""
    if options.action is None:
        names = ", ".join(ACTIONS)
        raise BadInputError(f"an action is missing: {names}; see 'cloudrc faults --help'")
    require("the fault suite", ("world", "record"))
    from cloudrc.cli import faults_fuzz, faults_run

    actions = {
        "list": faults_run.show,
        "run": faults_run.run,
        "fuzz": faults_fuzz.fuzz,
        "replay": faults_fuzz.replay,
    }
    return actions[options.action](options)
