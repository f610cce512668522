"""The checks of the exercise: full points for the solution, none for the files to fill in."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from contextlib import closing, suppress
from io import BytesIO
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest

from cloudrc import exercise
from cloudrc.cli.main import main
from cloudrc.exercise import checks, scoring
from cloudrc.exercise import files as written
from cloudrc.exercise.hand_in import FILES, HandIn, serve, to_plain
from cloudrc.exercise.remote import HandInError, Remote
from tests.conftest import wait_until

SOLUTION = Path(__file__).with_name("solution")
ALL = {part: [check.test for check in checks.CHECKS[part]] for part in FILES}
STUBS = Path(exercise.__file__).parent


@pytest.mark.parametrize(("value", "plain"), [(np.int64(3), 3), (3, 3), (np.float64(3), 3.0)])
def test_an_integer_of_a_student_stays_one(value, plain):
    assert (to_plain(value), type(to_plain(value))) == (plain, type(plain))


def score(part, folder):
    """Score a part; the student's functions run in this process."""
    hand_in = HandIn(folder)

    def ask(calls):
        return json.loads(json.dumps(hand_in.answer(json.loads(json.dumps(calls)))))

    return list(checks.run(part, Remote(ask), folder))


@pytest.mark.parametrize(("folder", "points"), [(STUBS, 0), (SOLUTION, 100)])
@pytest.mark.parametrize("part", checks.CHECKS)
def test_a_stub_scores_nothing_and_the_solution_all(part, folder, points):
    for row in score(part, folder):
        assert row["points"] == row["max_points"] * points / 100, row


# Part, text of the solution, what a student writes instead, lost tests, text of the first one.
@pytest.mark.parametrize(
    ("part", "right", "wrong", "lost", "said"),
    [
        ("estimator", "/ (self.count + 1)", "* 0.05", ["mean", "hold time"], "not"),
        ("estimator", "sample.loop_delay", "sample.rtt", ["hold time", "steps"], "[0.0, 0.06]"),
        (
            "estimator",
            "return self.mean",
            "return 'x'",
            ALL["estimator"],
            "y:14: InvalidValueError: ",
        ),
        ("predictor", "p + v *", "p - v *", ["position", "steps"], "predictor.py:7: gives [0.95"),
        ("predictor", "v * horizon", "v * 1e999", ALL["predictor"][::3], "gives [inf"),
        (
            "predictor",
            "round(horizon * 1e9)",
            "horizon * 1e9",
            ALL["predictor"][2:],
            "predictor.py:7: its stamp is 1",
        ),
        ("predictor", "horizon):", "horizon)", ALL["predictor"], "predictor.py:7: SyntaxError: "),
        (
            "predictor",
            "def predict(",
            "def predicts(",
            ALL["predictor"],
            "predictor.py: ValueError: build() returned StudentPredictor, which has no method",
        ),
        ("controller", "(error - self", "(self.last - self", ["D"], "controller.py:17: gives [0."),
        ("controller", "np.subtract(", "-np.subtract(", ["P", "steps"], "controller.py:17: gives"),
        ("controller", "np.clip(u, -limit, limit)", "u", ["limit"], "gives [0.8, 0.8, 0.75], not"),
        ("controller", "np.clip(u, -limit, limit)", "u[:2]", ALL["controller"], "controller.py:17"),
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
    assert [row["test"] for row in rows] == [
        each[0] for part in checks.CHECKS.values() for each in part
    ]
    assert seen["estimator"] == "delay_estimator.py: no end after 4 s of processor time"
    assert seen["predictor"] == "predictor.py:2: SystemExit: no (sys.exit() was called)"
    assert seen["controller"] == "controller.py: ended the process of the check"
    assert {row["points"] for row in rows} == {0.0}
    assert {row["valid"] for row in rows} == {True}


def test_a_process_that_a_file_forks_does_not_answer(monkeypatch):
    """Else its answer was taken for that of the file which was called next."""

    def leave(status):
        raise SystemExit(status)

    hand_in, calls = HandIn(SOLUTION), [("predictor 1", "build", {})]
    assert hand_in.answer(calls) == (None, "")
    monkeypatch.setattr(os, "_exit", leave)
    monkeypatch.setattr(os, "getpid", lambda: -1)
    with pytest.raises(SystemExit):
        hand_in.answer(calls)


def test_a_file_of_the_hand_in_is_found_by_its_name_from_everywhere(tmp_path, monkeypatch):
    text = (SOLUTION / "predictor.py").read_text()
    (tmp_path / "predictor.py").write_text(f"open('gains.json').close()\n{text}")
    (tmp_path / "gains.json").touch()
    monkeypatch.chdir("/")
    answers = BytesIO()
    serve(tmp_path, BytesIO(b'[1, [["predictor 1", "build", {}]]]\n'), answers)
    assert json.loads(answers.getvalue()) == [1, None, ""]


@pytest.mark.process
def test_a_wait_costs_no_processor_time_and_ends_with_a_score_that_is_not_valid(tmp_path):
    """A loaded computer gives a right hand-in too little processor time, which costs no points."""
    text = (SOLUTION / "predictor.py").read_text()
    (tmp_path / "predictor.py").write_text(f"import time\ntime.sleep(4.0)\n{text}")
    with closing(scoring.Process(tmp_path, limit=3)) as process:
        Remote(process.ask).build("predictor").predict(checks.STATE, 0.1)
        assert not process.too_slow
    with closing(scoring.Process(tmp_path, limit=10, patience=0.1)) as process:
        with pytest.raises(HandInError, match=r"^predictor\.py: too slow here"):
            Remote(process.ask).build("predictor")
        assert process.too_slow


def test_a_failure_of_all_parts_together_names_the_files_that_were_called():
    calls = [("predictor 3", "observe", []), ("estimator 2", "horizon", [1.0])]
    assert scoring._files_of(calls[1:]) == "delay_estimator.py"
    assert scoring._files_of(calls) == "delay_estimator.py or predictor.py"


# What a file writes in place of an answer.
FORGERIES = {
    "no JSON": b"right, 100 of 100\n",
    "another number": b'[7, [1e9], ""]\n',
    "rows": b'[{"points": 1e6}]\n',
    "no text": b'[1, 1e9, {"points": 1e6}]\n',
    "deep": b"[" * 60_000 + b"\n",
    "no end": b"1" * 70_000,
    "a huge integer": b"1" * 5_000 + b"\n",
    "the process ends": b"",
}


@pytest.mark.process
@pytest.mark.parametrize("data", FORGERIES.values(), ids=FORGERIES)
def test_a_forged_answer_costs_the_part(data, tmp_path):
    """The file writes to every pipe of its process, and ends it."""
    write = f"for n in range(3, 9):\n    try: os.write(n, {data!r})\n    except OSError: pass\n"
    (tmp_path / "predictor.py").write_text(f"import os\n{write}os._exit(0)\n")
    process = scoring.Process(tmp_path, 20)
    remote = Remote(process.ask)
    for _ in range(2):
        with pytest.raises(HandInError, match=r"^predictor.py: (ended|sent) "):
            remote.build("predictor")
    process.close()


@pytest.mark.parametrize(
    ("answer", "points"),
    [
        (([1e9, [1e9] * 3, [1e9] * 4, [1e9] * 3, [1e9] * 3], ""), 0),
        (([0, [nan] * 3, [inf] * 4, [None] * 3, ["x"] * 3], ""), 0),
        ((["1.0", {"x": 1}, [], [[]], [[[1]]]], ""), 0),
        ((None, ""), 0),
        ((1e400, "x" * 9_999 + "\ud800\n\x1b"), 0),
    ],
)
def test_whatever_is_answered_the_rows_are_valid(answer, points):
    rows = list(checks.run("predictor", Remote(lambda calls: answer), STUBS))
    assert [row["points"] for row in rows] == [points] * 4
    json.dumps(rows, allow_nan=False).encode()
    assert all("\n" not in row["seen"] and len(row["seen"]) < 2500 for row in rows)


CHILDREN = {
    "subprocess": "subprocess.Popen(SLEEP)",
    "shell": "subprocess.Popen(['sh', '-c', ' '.join(SLEEP) + ' & wait'])",
    "fork": "os.fork() or os.execvp(SLEEP[0], SLEEP)",
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
    process = scoring.Process(tmp_path, 20)
    with suppress(HandInError):  # some files end their process
        process.ask([("predictor 1", "build", {})])
        wait_until(lambda: is_running(marker), 5.0)
    process.close()
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
    monkeypatch.setattr(checks.Exam, "score", lambda *_: (0.0, "not flown"))
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
    (tmp_path / "student.zip").write_bytes(b"PK")
    assert "is a file; if it is an archive, unpack it" in refused(
        "class check", tmp_path / "student.zip"
    )


def test_new_files_on_a_full_disk_are_named_and_none_is_left(tmp_path, monkeypatch, refused):
    def write(path, data):
        if path.name != "delay_estimator.py":
            raise OSError(errno.ENOSPC, "No space left on device", str(path))
        path.write_bytes(data)

    monkeypatch.setattr(written, "write_atomically", write)
    said = f"disk_full: {tmp_path / 'a/predictor.py'}: free some space, or choose another place\n"
    assert refused("class new", tmp_path / "a", code=3).endswith(said)
    assert [*(tmp_path / "a").iterdir()] == []


def test_each_test_is_told_as_it_ends(tmp_path, monkeypatch, capsys):
    """A check takes up to minutes; stdout carries the result alone."""
    row = {"part": "estimator", "points": 1.0, "max_points": 2, "seen": "right", "valid": False}

    def check(folder):
        for test in ("mean", "steps"):
            told.append(capsys.readouterr())
            yield row | {"test": test}

    told = []
    (tmp_path / "predictor.py").touch()
    monkeypatch.setattr(scoring, "check", check)
    assert main(["class", "check", str(tmp_path), "-o", "json"]) == 0
    told.append(capsys.readouterr())
    lines = [f"scores {tmp_path}\n", "  estimator, mean: 1/2\n", "  estimator, steps: 1/2\n"]
    assert [each.err for each in told] == lines
    assert [bool(each.out) for each in told] == [False, False, True]
    found = json.loads(told[-1].out)
    assert (found["score"], found["valid"]) == (2.0, False)
