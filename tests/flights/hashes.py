# SPDX-License-Identifier: Apache-2.0

"""Fly the commands of hashes.json, and keep what they record: `make hashes`.

Each line has a name, a command and the SHA-256 of the records of its flights. A commit that changes
a hash says why: all others leave every bit of a flight as it was.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import multiprocessing
import shlex
import tempfile
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from cloudrc.doors.cli.main import main
from tests.faults.scenarios import SCENARIOS

FILE = Path(__file__).with_name("hashes.json")
ROOT = FILE.parents[2]


def read() -> list[dict[str, str]]:
    """Return the lines of the file."""
    lines: list[dict[str, str]] = json.loads(FILE.read_text("utf-8"))
    return lines


def fly(command: str) -> str:
    """Run a command in the root folder of the project; return the hash of what it records.

    It is `cloudrc run`, `cloudrc eval`, or the test of a named fault.
    """
    program, *words = shlex.split(command)
    if program == "pytest":
        (name,) = (each.name for each in SCENARIOS.values() if f"{each.id}-" in words)
        return SCENARIOS[name].run(1).sha256
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(ROOT):
        said = io.StringIO()
        with contextlib.redirect_stdout(said):
            main([*words, "--out", f"{folder}/out", "-o", "json"])
        if words[0] == "run":
            return str(json.loads(said.getvalue())["records_sha256"])
        rows = Path(folder, "out", "rows.jsonl").read_text("utf-8").splitlines()
        each = sorted(json.loads(row)["records_sha256"] for row in rows)
        return hashlib.sha256("".join(each).encode()).hexdigest()


def _refreshed(line: dict[str, str]) -> dict[str, str]:
    return {**line, "records_sha256": fly(line["command"])}


def _write() -> None:
    """Fly all commands, write the file again, and print what has changed."""
    before = read()
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        now = list(pool.map(_refreshed, before))
    FILE.write_text(json.dumps(now, indent=1) + "\n", encoding="utf-8")
    changed = [line["name"] for line in now if line not in before]
    print(f"{len(now)} compared, {len(changed)} changed:", *changed)


if __name__ == "__main__":
    _write()
