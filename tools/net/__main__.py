# SPDX-License-Identifier: Apache-2.0

"""Keep the facts of this tree, or compare them with those kept."""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import cloudrc
from tools import net
from tools.net import flights, numbers, texts

PARTS: dict[str, Callable[[], dict[str, Callable[[], Any]]]] = {
    "flights": flights.tasks,
    "numbers": numbers.tasks,
    "texts": texts.tasks,
}
"""Name of a part -> function that returns name -> task; a task returns facts, as for JSON."""
ABSENT = "absent"
OF_OUR_CODE = "flights/raising*/records", "numbers/eval*/identity/env_code"
"""Facts that change with each line of our code: the stack of a failure, a fingerprint."""
Facts = dict[str, Any]
_tasks = dict[str, Callable[[], Any]]()


def run(name: str) -> tuple[str, Any]:
    """Run a task in a folder of its own; return its name and its facts."""
    folder = Path(tempfile.mkdtemp(prefix="net-"))
    os.chdir(folder)
    try:
        with warnings.catch_warnings(action="ignore"):  # flights that fail are part of the net
            facts = _tasks[name]()
    except Exception as error:
        facts = {
            "raised": f"{type(error).__name__}: {error}",
            "where": traceback.format_exc()[-800:],
        }
    text = json.dumps(facts, default=str)
    for place, word in (
        (str(folder), "FOLDER"),
        (str(Path(cloudrc.__file__).parents[1]), "SOURCE"),
    ):
        text = text.replace(place, word)
    return name, json.loads(text)


def leaves(value: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the place and the value of each leaf of a JSON document."""
    below: Any = None
    if isinstance(value, Mapping):
        below = value.items()
    elif isinstance(value, list):
        below = enumerate(value)
    if not below:
        yield place, value
        return
    for key, each in below:
        yield from leaves(each, f"{place}/{key}")


def differences(before: Facts, after: Facts) -> Iterator[str]:
    """Yield a line for each task whose facts differ, with the first places that do."""
    for name, old in before.items():
        have = dict(leaves(old)), dict(leaves(after.get(name, ABSENT)))
        differ = [
            place
            for place in sorted(have[0].keys() | have[1].keys())
            if have[0].get(place, ABSENT) != have[1].get(place, ABSENT)
            and not any(fnmatchcase(f"{name}{place}", each) for each in OF_OUR_CODE)
        ]
        if differ:
            shown = [
                f"    {place}: {str(have[0].get(place, ABSENT))[:160]!r} -> "
                f"{str(have[1].get(place, ABSENT))[:160]!r}"
                for place in differ[:4]
            ]
            more = [f"    and {len(differ) - 4} more"] if len(differ) > 4 else []
            yield "\n".join([name, *shown, *more])


def main() -> int:
    """Run all tasks, and write or compare their facts; return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.net", description=net.__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--write", type=Path, metavar="FILE", help="keep the facts of this tree")
    action.add_argument("--compare", type=Path, metavar="FILE", help="compare them with those kept")
    parser.add_argument("--part", choices=PARTS, help="only this part")
    parser.add_argument("--only", metavar="PATTERN", default="*", help="only tasks of this name")
    args = parser.parse_args()
    for part, tasks in PARTS.items():
        if args.part in (None, part):
            found = {f"{part}/{name}": task for name, task in tasks().items()}
            _tasks.update(
                {name: each for name, each in found.items() if fnmatchcase(name, args.only)}
            )
    file = (args.write or args.compare).absolute()
    with multiprocessing.get_context("fork").Pool(maxtasksperchild=1) as pool:
        facts = dict(pool.imap(run, _tasks, chunksize=1))
    if args.write:
        file.write_text(json.dumps(facts, indent=1))
        raised = [
            name for name, each in facts.items() if isinstance(each, dict) and "raised" in each
        ]
        print(*(f"{name}: {facts[name]['raised']}" for name in raised), sep="\n")
        print(f"{len(facts)} tasks, {len(raised)} raised")
        return 0
    before = {name: each for name, each in json.loads(file.read_text()).items() if name in facts}
    found = list(differences(before, facts))
    print(*found, f"{len(before) - len(found)} of {len(before)} tasks are equal", sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
