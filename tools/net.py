"""Check that a change of the code leaves the flights as they were.

    python -m tools.net --write before.json     # on the commit before
    python -m tools.net --compare before.json   # on the changed tree; exit 1 if a flight differs

Flies 50 flights in virtual time, in less than a minute: five experiments over five links, each with
two seeds. Of each flight it keeps the verdict, the codes of the failures, all numbers, the hash of
all records, and two hashes of arrays: the true path with its velocities, and the commands of cloud.
`--compare` looks at all of them; with `--path` it leaves out the hash of all records and the
numbers, for a change that adds or renames columns on purpose.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import sys
import warnings
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias

import cloudrc

EXPERIMENTS = "paper", "paper-verbatim", "steps", "hover", "fast"
LINKS = "paper-p1", "paper-p2", "paper-p3", "lossy", "satellite"
SEEDS = 1, 2
ARRAYS = {
    "path": ("/ground_truth", ("stamp_ns", "position", "orientation_wxyz", "velocity")),
    "commands": ("/cmd_vel", ("stamp_ns", "command", "yaw_rate")),
}
"""Name of a hash -> the topic and the columns that it covers."""
ALWAYS = "verdict", "codes", *ARRAYS
"""What is compared with `--path`, too."""
Facts: TypeAlias = dict[str, Any]


def fly(point: tuple[str, str, int]) -> Facts:
    """Fly an experiment over a link with a seed; return what is kept of the flight."""
    experiment, link, seed = point
    with warnings.catch_warnings(action="ignore"):  # flights that fail are part of the net
        result = cloudrc.fly(experiment, {"link.profile": link}, seed=seed)
    hashes = {}
    for name, (topic, columns) in ARRAYS.items():
        digest = hashlib.sha256()
        for column in columns:
            digest.update(result[topic][column].tobytes())
        hashes[name] = digest.hexdigest()
    return {
        "verdict": result.verdict,
        "codes": [failure.code for failure in result.failures],
        **hashes,
        "records": result.records_sha256,
        "numbers": result.numbers,
    }


def fly_all() -> dict[str, Facts]:
    """Fly all flights on all cores; return name of the flight -> what is kept of it."""
    points = list(product(EXPERIMENTS, LINKS, SEEDS))
    with multiprocessing.Pool() as pool:
        found = pool.map(fly, points, chunksize=1)
    return {"/".join(map(str, point)): facts for point, facts in zip(points, found, strict=True)}


def differences(before: dict[str, Facts], after: dict[str, Facts], *, path: bool) -> Iterator[str]:
    """Yield a line for each flight that differs; with `path`, only path, commands and verdict."""
    for flight, old in before.items():
        new = after[flight]
        differ = [key for key in old if old[key] != new[key] and (key in ALWAYS or not path)]
        if "numbers" in differ:
            names = sorted(old["numbers"].keys() | new["numbers"].keys())
            moved = [n for n in names if old["numbers"].get(n) != new["numbers"].get(n)]
            differ[differ.index("numbers")] = f"numbers ({', '.join(moved)})"
        if differ:
            yield f"{flight}: {', '.join(differ)}"


def main() -> int:
    """Fly, and write or compare; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    action = parser.add_mutually_exclusive_group(required=True)
    action.add_argument("--write", type=Path, metavar="FILE", help="keep the flights of this tree")
    action.add_argument("--compare", type=Path, metavar="FILE", help="compare them with those kept")
    parser.add_argument("--path", action="store_true", help="compare only paths and verdicts")
    args = parser.parse_args()
    flights = fly_all()
    if args.write:
        args.write.write_text(json.dumps(flights, indent=1))
        return 0
    found = list(differences(json.loads(args.compare.read_text()), flights, path=args.path))
    print(*found, f"{len(flights) - len(found)} of {len(flights)} flights are equal", sep="\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
