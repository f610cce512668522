# SPDX-License-Identifier: Apache-2.0

"""Memory and processes of hand-ins: each row is there, whatever they take, and none is left."""

import csv
import os
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

from tests.studies.exercise.test_checks import OWN, SOLUTION

RIGHT = (SOLUTION / "predictor.py").read_text()
SLEEP = f"7{os.getpid()}00"
CHILD = "import os, time; os.setsid(); x = bytearray(b'1') * 10**8; time.sleep({})"
POPEN = "        import subprocess; subprocess.Popen(['sleep', '{}'], start_new_session=True)\n"
DEF = "def predict("
HEADS = {
    "list": "x = [0] * 10**10",
    "allowed": "x = bytearray(10**9)",
    "z grows": "x = []\nwhile True: x.append(b'1' * 10**7)",
    "children": "import subprocess, sys, time\nfor _ in range(60):\n"
    f"    subprocess.Popen([sys.executable, '-S', '-c', \"{CHILD.format(SLEEP)}\"])\n"
    "time.sleep(60)",
    "fork": f"import os\nwhile os.fork(): pass\nos.execlp('sleep', 'sleep', '{SLEEP}')",
}
"""Name of a hand-in -> what stands before the right predictor; those that grow are far apart."""
SAID = {
    "list": "predictor.py:1: used more than 2 GiB",
    "allowed": "",
    "z grows": "predictor.py:2: used more than 2 GiB",
    "children": "used more than 2 GiB",
    "fork": "predictor.py:2: started more than 64 processes",
    "call": "predictor.py:",
    "right": "",
}
ANOTHER = ["setpriv", "--reuid=65534", "--inh-caps=+dac_override", "--ambient-caps=+dac_override"]
"""Start of a command line for another user, who may read the files of the tests."""


def write_class(folder):
    """Write a task and a hand-in of each kind."""
    (folder / "own.yaml").write_text(OWN)
    (folder / "mine.yaml").write_text(
        "mission: {waypoints: [{position_m: [0.5, 0, 1]}]}\ncriteria: {time_limit_s: 1}\n"
    )
    for name, head in {**HEADS, "right": ""}.items():
        (folder / "all" / name).mkdir(parents=True)
        (folder / "all" / name / "predictor.py").write_text(f"{head}\n{RIGHT}")
    before, name, after = RIGHT.partition(DEF)
    line = after.index("\n") + 1
    popen = POPEN.format(SLEEP)
    (folder / "all" / "call").mkdir()
    (folder / "all/call/predictor.py").write_text(
        before + name + after[:line] + popen + after[line:]
    )


def memory_of_children(process):
    """Return the memory of a process and its descendants [bytes]."""
    found = [process]
    total = 0
    for each in found:
        try:
            for file in Path(f"/proc/{each}/task").glob("*/children"):
                found += file.read_text().split()
            pss = Path(f"/proc/{each}/smaps_rollup").read_text()
            total += int(pss.partition("\nPss:")[2].split()[0]) << 10
        except (OSError, IndexError):  # it has just ended
            continue
    return total


def check(folder, command=()):
    """Score the class; return its rows, and the largest memory of all processes at once [bytes]."""
    line = [*command, sys.executable, "-m", "cloudrc", "class", "check"]
    line += [*sorted(map(str, (folder / "all").iterdir())), "--task", str(folder / "own.yaml")]
    with (folder / "points.csv").open("w+") as out:
        process, most = subprocess.Popen(line, stdout=out, cwd=folder), 0
        while process.poll() is None:
            most = max(most, memory_of_children(process.pid))
            time.sleep(0.05)
        assert process.returncode == 0
        out.seek(0)
        return {row["hand_in"]: row for row in csv.DictReader(out)}, most


NOTEBOOK = '{"cells": [], "metadata": {}, "nbformat": 4, "nbformat_minor": 5}'
OTHERS = {
    "predictor.ipynb": (NOTEBOOK, "nbconvert --to script predictor.ipynb --output predictor"),
    "predictor.py": (NOTEBOOK, "predictor.py is a notebook"),
    "predictor (1).py": (RIGHT, "there is 'predictor (1).py': rename it to predictor.py"),
    "exercise/predictor.py": (RIGHT, ""),
    "exercise.zip": (b"no zip", "exercise.zip: no zip that can be read"),
    "notes.txt": ("nothing", "predictor.py is missing"),
    "a.py": ("import helper", "predictor.py is missing"),
}
"""File of a hand-in -> its content, and what the table says."""


def write_others(folder):
    """Write hand-ins with other files, four of each, and two zips; return what each row says."""
    said = {}
    for n, (name, (content, says)) in enumerate([*OTHERS.items()] * 4):
        path = folder / "all" / f"other {n}" / name
        path.parent.mkdir(parents=True)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        said[f"other {n}"] = says
    for path in (folder / "all/anna.zip", folder / "all/bert/exercise.zip"):
        path.parent.mkdir(exist_ok=True)
        with zipfile.ZipFile(path, "w") as file:
            file.writestr("exercise/predictor.py", RIGHT)
            file.writestr("__MACOSX/exercise/._predictor.py", "x")
    return {**said, "anna.zip": "", "bert": ""}


def no_process_is_left():
    return subprocess.run(["pgrep", "-f", SLEEP], stdout=subprocess.DEVNULL).returncode == 1


@pytest.mark.process
@pytest.mark.skipif(sys.platform != "linux", reason="the limits hold on Linux alone")
@pytest.mark.parametrize("command", [[], ANOTHER], ids=["this user", "a user of 100 processes"])
def test_a_part_has_its_own_memory_and_processes_and_leaves_none(command, tmp_path):
    if command and (os.getuid() or not shutil.which(command[0])):
        pytest.skip("needs root and setpriv, to become another user")
    write_class(tmp_path)
    busy = [subprocess.Popen([*command, "sleep", "600"]) for _ in range(100 if command else 0)]
    try:
        rows, _ = check(tmp_path, command)
    finally:
        for process in busy:
            process.kill()
            process.wait()
    assert no_process_is_left()
    judge(rows, SAID)
    assert "started more than 64 processes" in rows["call"]["remarks"]


def judge(rows, told):
    """Check that each row is there, and what its remark says."""
    assert {*rows} == {*told}
    for name, said in told.items():
        seen = rows[name]["remarks"]
        assert said in seen, (name, seen)
        assert bool(seen) == bool(said), (name, seen)
        assert (float(rows[name]["score"]) > 0.0) == (not said)
        assert rows[name]["valid"] == "True"


@pytest.mark.process
@pytest.mark.skipif(sys.platform != "linux", reason="the limits hold on Linux alone")
def test_of_a_class_of_forty_each_hand_in_gets_a_row_and_the_memory_stays_small(tmp_path):
    write_class(tmp_path)
    told = {**SAID, **write_others(tmp_path)}
    for n in range(40 - len(told)):
        shutil.copytree(tmp_path / "all/list", tmp_path / "all" / f"list {n}")
        told[f"list {n}"] = SAID["list"]
    rows, most = check(tmp_path, ())
    judge(rows, told)
    assert len(rows) == 40
    assert most < 3 << 30
    assert no_process_is_left()


@pytest.mark.process
def test_a_table_that_was_cut_short_gets_the_rows_that_it_lacks(tmp_path, call, refused):
    for name in ("anna", "bert", "carl"):
        (tmp_path / name).mkdir()  # no file: nothing runs
    table = tmp_path / "points.csv"
    names = [str(tmp_path / name) for name in ("anna", "bert", "carl")]
    lines = call("class check", *names).out.splitlines(keepends=True)
    assert len(lines) == 4
    anna = next(line for line in lines if line.startswith("anna"))
    table.write_text(lines[0] + anna.replace("0.0", "7.0") + lines[2][:20])
    call("class check --resume", table, *names)
    rows = sorted(table.read_text().splitlines()[1:])
    assert [row[:4] for row in rows] == ["anna", "bert", "carl"]
    assert rows[0].startswith("anna,7.0")  # the row of the earlier call stays
    table.write_text("name,mark\n")
    assert "other columns" in refused("class check --resume", table, *names)
    assert table.read_text() == "name,mark\n"
