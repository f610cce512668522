"""The checks of the exercise: full points for the solution, none for the files to fill in."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cloudrc import exercise
from cloudrc.exercise import checks, scoring
from cloudrc.exercise.files import FILES
from cloudrc.exercise.points import POINTS
from tests.conftest import nightly, wait_until

SOLUTION = Path(__file__).with_name("solution")
ALL = {part: [*tests] for part, tests in POINTS.items()}
STUBS = Path(exercise.__file__).parent


def score(part, folder):
    """Score a part; the student's functions run in this process."""
    rows = zip(POINTS[part].items(), checks.run(part, folder), strict=True)
    return [{"test": test, "max_points": most, **row} for (test, most), row in rows]


@pytest.mark.parametrize("part", checks.CHECKS)
def test_the_solution_scores_all(part):
    for row in score(part, SOLUTION):
        assert row["points"] == row["max_points"], row


@pytest.mark.parametrize("part", sorted(checks.CHECKS.keys() - {"together"}) + nightly("together"))
def test_a_stub_scores_nothing(part):
    assert [row for row in score(part, STUBS) if row["points"]] == []


# Part, text of the solution, what a student writes instead, lost tests, text of the first one.
@pytest.mark.parametrize(
    ("part", "right", "wrong", "lost", "said"),
    [
        ("estimator", "/ (self.count + 1)", "* 0.05", ["mean", "hold time"], "not"),
        ("predictor", "horizon):", "horizon)", ALL["predictor"], "predictor.py:7: SyntaxError: "),
        (
            "predictor",
            "def predict(",
            "def predicts(",
            ALL["predictor"],
            "predictor.py: ValueError: build() returned StudentPredictor, which has no method",
        ),
        ("controller", "np.subtract(", "-np.subtract(", ["P", "steps"], "controller.py: gives"),
    ],
)
def test_an_error_costs_the_points_that_it_concerns(part, right, wrong, lost, said, tmp_path):
    name = FILES[part]
    text = (SOLUTION / name).read_text()
    assert right in text
    (tmp_path / name).write_text(text.replace(right, wrong))
    rows = score(part, tmp_path)
    less = [row for row in rows if row["points"] < row["max_points"]]
    assert [row["test"] for row in less] == lost, rows
    assert said in less[0]["seen"]


@pytest.mark.process
def test_whatever_a_file_does_the_other_parts_are_scored(tmp_path):
    (tmp_path / "delay_estimator.py").write_text("while True:\n    print('on and on')\n")
    (tmp_path / "predictor.py").write_text("import sys\nsys.exit('no')\n")
    (tmp_path / "controller.py").write_text("import os\nos._exit(0)\n")
    rows = list(scoring.check(tmp_path, limit=4))
    seen = {row["part"]: row["seen"] for row in rows}
    assert [row["test"] for row in rows] == [test for tests in POINTS.values() for test in tests]
    assert seen["estimator"] == "delay_estimator.py: no end after 4 s of processor time"
    assert seen["predictor"] == "predictor.py:2: SystemExit: no (sys.exit() was called)"
    assert seen["controller"].startswith("controller.py: ended the process of the check")
    assert {row["points"] for row in rows} == {0.0}
    assert {row["valid"] for row in rows} == {True}


# What a file writes in place of rows, and the points of the part's tests then.
FORGERIES = {
    "too many points": (
        b'{"points": 1e6, "seen": "x"}\n{"points": NaN, "seen": ""}\n',
        [6, 0, 0, 0],
    ),
    "no end": (b"1" * 70_000, [0, 0, 0, 0]),
}


@pytest.mark.process
@pytest.mark.parametrize("name", FORGERIES)
def test_forged_rows_cost_or_give_the_points_of_their_part_at_most(name, tmp_path, monkeypatch):
    """The file writes to every pipe of its process, and ends it."""
    data, points = FORGERIES[name]
    write = f"for n in range(3, 9):\n    try: os.write(n, {data!r})\n    except OSError: pass\n"
    (tmp_path / "predictor.py").write_text(f"import os\n{write}os._exit(0)\n")
    monkeypatch.setattr(scoring, "POINTS", {"predictor": POINTS["predictor"]})
    rows = list(scoring.check(tmp_path, 20))
    assert [row["points"] for row in rows] == points
    json.dumps(rows, allow_nan=False).encode()
    assert all("\n" not in row["seen"] and len(row["seen"]) < 2500 for row in rows)


@pytest.mark.process
def test_a_wait_costs_no_processor_time_and_ends_with_a_score_that_is_not_valid(
    tmp_path, monkeypatch
):
    """A loaded computer gives a right hand-in too little processor time, which costs no points."""
    text = (SOLUTION / "predictor.py").read_text()
    (tmp_path / "predictor.py").write_text(f"import time\ntime.sleep(60.0)\n{text}")
    monkeypatch.setattr(scoring, "POINTS", {"predictor": POINTS["predictor"]})
    first, *_ = scoring.check(tmp_path, limit=10, patience=0.1)
    assert "too slow here" in first["seen"]
    assert not first["valid"]


@pytest.mark.process
def test_a_file_of_the_hand_in_is_found_by_its_name_from_everywhere(tmp_path, monkeypatch):
    text = (SOLUTION / "predictor.py").read_text()
    (tmp_path / "predictor.py").write_text(f"open('gains.json').close()\n{text}")
    (tmp_path / "gains.json").touch()
    monkeypatch.chdir("/")
    data, _ = scoring.run_part("predictor", tmp_path, 20, 200.0)
    assert scoring.read_rows(data)[0] == (6.0, "right")


CHILDREN = {
    "a fork of a fork": "os.fork() or (os.fork() or os.execvp(SLEEP[0], SLEEP)) and os._exit(0)",
    "a fork, and the end": "os.fork() and os._exit(0)\nos.execvp(SLEEP[0], SLEEP)",
}


def is_running(marker):
    processes = [path for path in Path("/proc").iterdir() if path.name.isdecimal()]
    return any(marker in _command_of(path) for path in processes)


def _command_of(process):
    try:
        return (process / "cmdline").read_bytes().decode().split("\0")[1:]
    except OSError:  # it has just ended
        return []


def leave(child, folder):
    """Write a file that leaves a child, and return a text in the child's command line."""
    marker = f"9{os.getpid()}{time.monotonic_ns() % 10**6}"
    head = f"import os, subprocess\nSLEEP = ['sleep', '{marker}']\n{child}\n"
    text = (SOLUTION / "predictor.py").read_text()
    (folder / "predictor.py").write_text(f"{head}{text}")
    return marker


needs_proc = pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs /proc")


@needs_proc
@pytest.mark.process
@pytest.mark.parametrize("child", CHILDREN.values(), ids=CHILDREN)
def test_no_child_of_a_file_outlives_the_check(child, tmp_path):
    marker = leave(child, tmp_path)
    scoring.run_part("predictor", tmp_path, 20, 200.0)
    wait_until(lambda: not is_running(marker), 5.0)


@needs_proc
@pytest.mark.process
@pytest.mark.parametrize(
    ("number", "code", "loop"),
    [
        (signal.SIGINT, 130, "while True: pass"),
        (signal.SIGKILL, -9, "any(iter(int, 1))"),  # lets no other thread run
    ],
)
def test_neither_a_loop_nor_its_child_outlives_the_check(number, code, loop, tmp_path):
    marker = leave(f"subprocess.Popen(SLEEP)\n{loop}", tmp_path)
    (tmp_path / "predictor.py").rename(tmp_path / "delay_estimator.py")
    line = [sys.executable, "-m", "cloudrc", "class", "check", str(tmp_path)]
    command = subprocess.Popen(line, stdout=subprocess.DEVNULL)
    wait_until(lambda: is_running(marker), 60.0)
    command.send_signal(number)
    assert command.wait(20.0) == code
    wait_until(lambda: not is_running(marker) and not is_running(str(tmp_path)), 5.0)


@pytest.mark.process
def test_gradescope_gets_the_points_of_new_files(tmp_path, call, monkeypatch):
    call("class new", tmp_path / "a")
    (tmp_path / "a" / "predictor.py").unlink()
    found = json.loads(call("class check -o gradescope", tmp_path / "a").out)
    assert found["score"] == 0.0
    assert sum(test["max_score"] for test in found["tests"]) == 100
    assert found["tests"][3]["output"].endswith("'predictor.py': there is no such file")
    assert {test["visibility"] for test in found["tests"]} == {"visible"}


def test_files_are_not_overwritten_and_a_folder_must_exist(tmp_path, refused):
    (tmp_path / "controller.py").write_text("my work")
    refused("class new", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["controller.py"]
    refused("class check", tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "has none of delay_estimator.py" in refused("class check", tmp_path / "empty")
