"""The checks of the exercise: full points for the solution, none for the files to fill in."""

import json
from pathlib import Path

import pytest

from cloudrc import exercise
from cloudrc.cli import class_
from cloudrc.exercise import checks

SOLUTION = Path(__file__).with_name("solution")
ALL = {part: [check.test for check in checks.CHECKS[part]] for part in checks.PARTS}
STUBS = Path(exercise.__file__).parent


@pytest.mark.parametrize(("folder", "score"), [(STUBS, 0), (SOLUTION, 100)])
@pytest.mark.parametrize("part", checks.CHECKS)
def test_a_stub_scores_nothing_and_the_solution_all(part, folder, score):
    for row in checks.run(part, folder):
        assert row["points"] == row["max_points"] * score / 100, row


# Part, text of the solution, what a student writes instead, lost tests, text of the first one.
@pytest.mark.parametrize(
    ("part", "right", "wrong", "lost", "said"),
    [
        ("estimator", "/ (self.count + 1)", "* 0.05", ["mean", "hold time"], "not"),
        ("estimator", "sample.loop_delay", "sample.rtt", ["hold time", "steps"], "[0.0, 0.06]"),
        ("estimator", "return self.mean", "return 'x'", ALL["estimator"], "y:14: ValueError: "),
        ("predictor", "p + v *", "p - v *", ["position", "steps"], "predictor.py:7: gives [0.95"),
        ("predictor", "v * horizon", "v * 1e999", ALL["predictor"][::3], "gives [inf"),
        ("predictor", "horizon):", "horizon)", ALL["predictor"], "predictor.py:7: SyntaxError: "),
        ("controller", "(error - self", "(self.last - self", ["D"], "controller.py:17: gives [0."),
        ("controller", "np.subtract(", "-np.subtract(", ["P", "steps"], "controller.py:17: gives"),
        ("controller", "np.clip(u, -limit, limit)", "u", ["limit"], "gives [0.8, 0.8, 0.75], not"),
        ("controller", "np.clip(u, -limit, limit)", "u[:2]", ALL["controller"], "controller.py:17"),
    ],
)
def test_an_error_costs_the_points_that_it_concerns(part, right, wrong, lost, said, tmp_path):
    name, *_ = checks.PARTS[part]
    text = (SOLUTION / name).read_text()
    assert right in text
    (tmp_path / name).write_text(text.replace(right, wrong))
    rows = checks.run(part, tmp_path)
    less = [row for row in rows if row["points"] < row["max_points"]]
    assert [row["test"] for row in less] == lost, rows
    assert said in less[0]["seen"]


@pytest.mark.process
def test_whatever_a_file_does_the_other_parts_are_scored(tmp_path):
    (tmp_path / "delay_estimator.py").write_text("while True:\n    print('on and on')\n")
    (tmp_path / "predictor.py").write_text("import sys\nsys.exit('no')\n")
    (tmp_path / "controller.py").write_text("import os\nos._exit(0)\n")
    rows = class_.check(tmp_path, limit=10.0)
    seen = {row["part"]: row["seen"] for row in rows}
    assert [row["test"] for row in rows] == [
        each[0] for part in checks.CHECKS.values() for each in part
    ]
    assert seen["estimator"] == "delay_estimator.py: no end after 10 s"
    assert seen["predictor"] == "predictor.py:2: SystemExit: no"
    assert seen["controller"] == "controller.py: ended the process of the check"
    assert {row["points"] for row in rows} == {0.0}


@pytest.mark.process
def test_gradescope_gets_the_points_of_new_files(tmp_path, call):
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
