# SPDX-License-Identifier: Apache-2.0

"""The checks of the exercise: full points for the solution, none for the files to fill in."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from itertools import chain
from pathlib import Path

import pytest

from cloudrc.config.shipped import file_of
from cloudrc.config.task import read_task
from cloudrc.studies import exercise
from cloudrc.studies.exercise import checks, scoring
from cloudrc.studies.exercise.files import SHIPPED, describe_missing
from cloudrc.studies.exercise.watch import Limits
from tests.conftest import nightly, nightly_rows, wait_until

SOLUTION = Path(__file__).with_name("solution")
TASK = read_task(SHIPPED)
SHORT = {"mission.steps.count": 2}
"""What a flight of the experiment `steps` needs to tell a wrong part from a right one."""
FILES = TASK.files
ALL = {part: [*about.tests] for part, about in TASK.parts.items()}
STUBS = Path(exercise.__file__).parent


def brief(task):
    """Return a task whose flights of `steps` are short."""
    made = task.model_copy(deep=True)
    for part in made.parts.values():
        for test in part.tests.values():
            if test.experiment == "steps":
                test.set.update(SHORT)
    return made


def score(part, folder, task=TASK):
    """Score a part; the student's functions run in this process."""
    rows = checks.run(task, part, folder, STUBS)
    tests = task.parts[part].tests.items()
    return [
        {"test": test, "max_points": about.points, **row}
        for (test, about), row in zip(tests, rows, strict=True)
    ]


@pytest.mark.parametrize(
    ("part", "task"),
    [
        *((part, brief(TASK)) for part in ALL),  # the flights of `together` are no steps
        *nightly_rows(*((part, TASK) for part in FILES)),
    ],
    ids=lambda each: each if isinstance(each, str) else "whole" if each is TASK else "brief",
)
def test_the_solution_scores_all(part, task):
    for row in score(part, SOLUTION, task):
        assert row["points"] == row["max_points"], row


@pytest.mark.parametrize("part", sorted(ALL.keys() - {"together"}) + nightly("together"))
def test_a_stub_scores_nothing(part):
    assert [row for row in score(part, STUBS, brief(TASK)) if row["points"]] == []


# Part, text of the solution, what a student writes instead, lost tests, text of the first one.
@pytest.mark.parametrize(
    ("part", "right", "wrong", "lost", "said"),
    [
        (
            "estimator",
            "(self.count + 1)",
            "(self.count + 2)",
            ["mean", "hold time"],
            "wrong horizons",
        ),
        ("predictor", "horizon):", "horizon)", ALL["predictor"], "predictor.py:7: SyntaxError: "),
        (
            "predictor",
            "def predict(",
            "def predicts(",
            ALL["predictor"],
            "predictor.py: ValueError: build() returned StudentPredictor, which has no method",
        ),
        (
            "controller",
            "np.subtract(",
            "-np.subtract(",
            ["P", "steps"],
            "controller.py: wrong",
        ),
    ],
)
def test_an_error_costs_the_points_that_it_concerns(part, right, wrong, lost, said, tmp_path):
    name = FILES[part]
    text = (SOLUTION / name).read_text()
    assert right in text
    (tmp_path / name).write_text(text.replace(right, wrong))
    rows = score(part, tmp_path, brief(TASK))
    less = [row for row in rows if row["points"] < row["max_points"]]
    assert [row["test"] for row in less] == lost, rows
    assert said in less[0]["seen"]


@pytest.mark.process
def test_whatever_a_file_does_the_other_parts_are_scored(tmp_path):
    (tmp_path / "delay_estimator.py").write_text("while True: print('on and on')\n")
    (tmp_path / "predictor.py").write_text("import sys\nsys.exit('no')\n")
    (tmp_path / "controller.py").write_text("import os\nos._exit(0)\n")
    rows = list(scoring.check(tmp_path, limits=Limits(seconds=4)))
    seen = {row["part"]: row["seen"] for row in rows}
    assert [row["test"] for row in rows] == [*chain(*ALL.values())]
    assert seen["estimator"] == "delay_estimator.py:1: no end after 4 s of processor time"
    assert seen["predictor"] == "predictor.py:2: SystemExit: no (sys.exit() was called)"
    assert seen["controller"].startswith("controller.py: ended the process of the check")
    assert {row["points"] for row in rows} == {0.0}
    assert {row["valid"] for row in rows} == {True}


def hand_in(folder, head):
    """Write the right predictor, behind other lines."""
    text = (SOLUTION / "predictor.py").read_text()
    (folder / "predictor.py").write_text(f"{head}\n{text}")


def only(monkeypatch, part):
    """Let the exercise have one part."""
    task = TASK.model_copy(update={"parts": {part: TASK.parts[part]}})
    monkeypatch.setattr(scoring, "read_task", lambda source: task)


@pytest.mark.process
@pytest.mark.parametrize(
    ("data", "points"),
    [
        (b'{"points": 1e6, "seen": "x"}\n{"points": NaN, "seen": ""}\n', [6, 0, 0, 0]),
        (b"1" * 70_000, [0, 0, 0, 0]),
    ],
    ids=["too many points", "no end"],
)
def test_forged_rows_cost_or_give_the_points_of_their_part_at_most(
    data, points, tmp_path, monkeypatch
):
    """The file writes to every pipe of its process, and ends it."""
    write = f"for n in range(3, 9):\n    try: os.write(n, {data!r})\n    except OSError: pass\n"
    (tmp_path / "predictor.py").write_text(f"import os\n{write}os._exit(0)\n")
    only(monkeypatch, "predictor")
    rows = list(scoring.check(tmp_path, limits=Limits(seconds=20)))
    assert [row["points"] for row in rows] == points
    json.dumps(rows, allow_nan=False).encode()
    assert all("\n" not in row["seen"] and len(row["seen"]) < 2500 for row in rows)


@pytest.mark.process
def test_a_wait_costs_no_processor_time_and_ends_with_a_score_that_is_not_valid(
    tmp_path, monkeypatch
):
    """A loaded computer gives a right hand-in too little processor time, which costs no points."""
    hand_in(tmp_path, "import time\ntime.sleep(60.0)")
    only(monkeypatch, "predictor")
    first, *_ = scoring.check(tmp_path, limits=Limits(seconds=10, patience=0.1))
    assert "too slow here" in first["seen"]
    assert not first["valid"]


@pytest.mark.process
def test_a_file_of_the_hand_in_is_found_by_its_name_from_everywhere(tmp_path, monkeypatch):
    hand_in(tmp_path, "open('gains.json').close()")
    (tmp_path / "gains.json").touch()
    monkeypatch.chdir("/")
    ran = scoring.run_part("predictor", tmp_path)
    assert scoring.read_rows(ran.rows)[0] == (6.0, "right")


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
    hand_in(folder, f"import os, subprocess\nSLEEP = ['sleep', '{marker}']\n{child}")
    return marker


@pytest.mark.process
@pytest.mark.parametrize("child", CHILDREN.values(), ids=CHILDREN)
def test_no_child_of_a_file_outlives_the_check(child, tmp_path):
    marker = leave(child, tmp_path)
    scoring.run_part("predictor", tmp_path)
    wait_until(lambda: not is_running(marker), 5.0)


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
    assert found["tests"][3]["output"].startswith("predictor.py is missing")
    assert {test["visibility"] for test in found["tests"]} == {"visible"}


OWN = """
parts:
  predictor:
    file: predictor.py
    tests:
      short: {points: 3, experiment: mine.yaml, number: duration, full: 0.5, none: 100}
"""


@pytest.fixture
def lecture(tmp_path, monkeypatch):
    """A folder with a lecturer's task, its experiment and the file to fill in."""
    monkeypatch.chdir(tmp_path)
    Path("own.yaml").write_text(OWN)
    point = "{position_m: [0.5, 0, 1]}"
    limit = "criteria: {time_limit_s: 1}"
    Path("mine.yaml").write_text(f"mission: {{waypoints: [{point}]}}\n{limit}\n")
    Path("predictor.py").write_text((SOLUTION / "predictor.py").read_text())
    return tmp_path


@pytest.mark.process
def test_a_class_with_its_own_task_gets_one_table(lecture, call):
    _, points, _ = call("class new own.yaml").out.splitlines()
    part, test, most, files, own = points.split()  # the file to fill in is the solution
    assert (part, test, most) == ("predictor", "short", "3")
    assert files == own > "0"
    assert sorted(path.name for path in Path("own").iterdir()) == [
        "mine.yaml",
        "predictor.py",
        "task.yaml",
    ]
    Path("own").rename("anna")
    call("class new own.yaml bert")
    Path("bert/predictor.py").rename("bert/Predictor(1).py")
    Path("bert/task.yaml").write_text("parts: {}")  # the lecturer's task counts
    lines = call("class check anna bert notes.txt --task own.yaml --jobs 2").out.splitlines()
    header, *rows = csv.reader(lines)
    anna, bert = sorted(rows)
    assert header[-2:] == ["predictor: short", "remarks"]
    assert (anna[0], anna[2], bert[:2]) == ("anna", "3", ["bert", "0.0"])
    assert 0.0 < float(anna[1]) <= 3.0
    assert "'Predictor(1).py': rename it to predictor.py" in bert[-1]


@pytest.mark.process
def test_a_task_hands_out_the_files_that_its_flights_name(lecture, call, refused):
    Path("flights").mkdir()
    Path("lab.xml").write_bytes(file_of("empty").read_bytes())
    Path("flights/leg.yaml").write_text("waypoints: [{position_m: [0.5, 0, 1]}]")
    Path("slow.yaml").write_text("uplink: &way {trace: slow.csv}\ndownlink: *way")
    Path("slow.csv").write_text("time_s,delay_ms\n0,60\n1,60\n")
    mine = "mission: leg.yaml\nworld: {scene: ../lab.xml}\ncriteria: {time_limit_s: 1}\n"
    Path("flights/mine.yaml").write_text(mine)
    task = OWN.replace("mine.yaml", "flights/mine.yaml")
    keys = "set: {link.profile: ./slow.yaml}, number: uplink_delay_mean, full: 0.06, none: 0"
    Path("own.yaml").write_text(task.replace("number: duration, full: 0.5, none: 100", keys))
    call("class new own.yaml anna/own")
    shutil.copytree("anna", "bert")
    Path("bert/own/predictor.py").unlink()
    handed = {str(path.relative_to("anna/own")) for path in Path("anna").rglob("*.*")}
    own = {"flights/leg.yaml", "flights/mine.yaml", "lab.xml", "slow.csv", "slow.yaml"}
    assert handed == own | {"predictor.py", "task.yaml"}
    for words in ("", " --task own.yaml"):
        lines = call(f"class check anna/own bert/own{words}").out.splitlines()
        anna, bert = sorted(csv.DictReader(lines), key=lambda row: row["hand_in"])
        # The delay is 60 ms; the flight ends before its waypoint, so 30 % of the points is all.
        assert (anna["hand_in"], anna["score"], anna["remarks"]) == ("anna/own", "0.9", "")
        assert (bert["hand_in"], bert["score"]) == ("bert/own", "0.0")
    Path("lab.xml").rename("../lab.xml")
    Path("flights/mine.yaml").write_text(mine.replace("../", "../../"))
    assert "lab.xml; put it beside the task" in refused("class new own.yaml carl")


@pytest.mark.parametrize(
    ("right", "wrong", "said"),
    [
        ("number: duration", "number: duratoin", "did you mean duration?"),
        ("file: predictor.py", "file: ../predictor.py", "own.yaml:4: parts.predictor.file"),
        ("number: duration, ", "", "either a formula, or a number"),
        ("none: 100", "none: 0.5", "give two different values"),
        ("file: predictor.py", "file: null", "no part has a file"),
    ],
)
def test_a_task_that_cannot_be_scored_is_refused_at_once(lecture, refused, right, wrong, said):
    Path("own.yaml").write_text(OWN.replace(right, wrong))
    assert said in refused("class new own.yaml")


def test_a_file_with_another_name_is_named(tmp_path, refused):
    (tmp_path / "Controller(1).py").touch()
    assert "'Controller(1).py': rename it to controller.py" in refused("class check", tmp_path)


def test_files_are_not_overwritten_and_a_folder_must_exist(tmp_path, refused):
    (tmp_path / "controller.py").write_text("my work")
    refused("class new", tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["controller.py"]
    refused("class check", tmp_path / "nowhere")
    (tmp_path / "empty").mkdir()
    assert "has none of delay_estimator.py" in refused("class check", tmp_path / "empty")


def test_a_notebook_is_the_remedy_for_its_own_part_alone(tmp_path):
    (tmp_path / "predictor.ipynb").write_text("{}")
    said = describe_missing(tmp_path, ["predictor.py", "controller.py"])
    assert said.count("nbconvert") == 1
    assert said.endswith("controller.py is missing")


ONE_COPY = """
import sys, weakref
class Data: pass
data = Data()
assert getattr(sys, "data_before", lambda: None)() is None, "there are two copies of the data"
sys.data_before = weakref.ref(data)
"""


def test_the_data_of_a_file_is_in_memory_once(lecture, monkeypatch):
    monkeypatch.setattr(sys, "data_before", lambda: None, raising=False)
    Path("predictor.py").write_text(ONE_COPY + Path("predictor.py").read_text())
    (row,) = checks.run(read_task(Path("own.yaml")), "predictor", lecture, lecture)
    assert row["points"] > 0, row["seen"]
