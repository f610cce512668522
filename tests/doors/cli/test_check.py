# SPDX-License-Identifier: Apache-2.0

"""`cloudrc check` of a plug-in; tests/doors/cli/test_robot.py checks robots, test_new.py more."""

import pytest

BEGIN = """
from math import nan

from cloudrc.plugin import *
"""
PREDICTOR = """
class Mine(Predictor):
    def predict(self, odometry, horizon):
        return {0}

build = Mine
"""
LATER = "odometry._replace(stamp_ns=odometry.stamp_ns + round(horizon * 1e9){0})"
ESTIMATOR = """
class Mine(Estimator):
    def horizon(self, age):
        return {0}

build = Mine
"""
CONTROLLER = """
class Mine(Controller):
    x = 0.0

    def update(self, estimate, setpoint, dt):
        self.x += 0.1
        return ControlOutput({0}, 0.0)

build = Mine
"""
PERCEPTION = """
class Mine(Perception):
    takes = "{0}"

    def see(self, seen, odometry):
        {1}

build = Mine
"""
EXECUTOR = """
from numpy.random import default_rng

class Mine(Newest):
    def action(self, tick):
        action = super().action(tick)
        return None if action is None else {0}

build = Mine
"""
METRIC = """
UNIT = "m"

def measure(flight):
    {0}
"""


@pytest.fixture
def mine(tmp_path):
    """Return a function that writes a plug-in."""

    def write(form, *parts):
        text = form
        for number, part in enumerate(parts):
            text = text.replace(f"{{{number}}}", part)
        (tmp_path / "mine.py").write_text(f'"""Mine."""\n{BEGIN}{text}')

    return write


@pytest.mark.parametrize(
    ("form", "parts", "kind", "why"),
    [
        (PREDICTOR, ["odometry"], "predictor", "add it to stamp_ns"),
        (PREDICTOR, ["LATER", ", position=(nan, 0.0, 0.0)"], "predictor", "did not return the"),
        (PREDICTOR, ["odometry.nothing"], "predictor", "mine.py:9: AttributeError"),
        (ESTIMATOR, ["0.1"], "estimator", "horizon() returned 0.1 s, not 0"),
        (ESTIMATOR, ["nan"], "estimator", "nan"),
        (CONTROLLER, ["(nan, 0.0, 0.0)"], "controller", "velocity"),
        (CONTROLLER, ["(self.x, 0.0, 0.0)"], "controller", "after reset(), update() still"),
        (CONTROLLER, ["(0.0, 0.0, 0.0)"], "controller", "2 of 2 steps did not settle"),
        (PERCEPTION, ["sonar", "return None"], "perception", "takes is 'sonar'"),
        (PERCEPTION, ["scan", "seen.ranges[:] = 0.0"], "perception", "copy it first"),
        (PERCEPTION, ["scan", "return seen.stamp_ns"], "perception", "not a Setpoint"),
        (EXECUTOR, ["1 / 0"], "executor", "mine.py:12: ZeroDivisionError"),
        (EXECUTOR, ["action + default_rng().random()"], "executor", "had different actions"),
        (METRIC, ["return 1 / 0"], "metric", "mine.py:10: ZeroDivisionError"),
        (METRIC, ["return nan"], "metric", "nan"),
    ],
)
def test_what_breaks_the_contract_fails_with_the_reason(mine, call, form, parts, kind, why):
    if parts[0] == "LATER":
        parts = [LATER.replace("{0}", parts[1])]
    mine(form, *parts)
    first, *held, last = call("check mine.py", code=1).out.splitlines()
    assert first == f"{kind} mine.py"
    assert all(line.startswith("ok: ") for line in held)
    assert last.startswith("fails: ")
    assert why in last


def test_a_plugin_in_order_is_told_line_by_line(mine, as_json, call):
    mine(METRIC, "return None")
    assert "measure() returned None" in call("check mine.py").out
    found = as_json("check mine.py")
    assert (found["plugin"], found["kind"], found["ok"]) == ("mine.py", "metric", True)
    assert [row["ok"] for row in found["checks"]] == [True, True]


def test_the_kind_may_be_named(mine, call):
    assert "ok: a flight over lte" in call("check running_mean --as estimator").out
    mine(ESTIMATOR, "0.0")
    call("check mine.py", code=0)
    assert "no method predict()" in call("check mine.py --as predictor", code=1).out


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("x = 1", "is no plug-in"),
        ("def build():\n    return 3", "returned int, which has the methods of no plug-in"),
        ("def build(model):\n    return 3", "checked with its robot"),
        ("def build(:", "mine.py, line 1"),
        ("def build():\n    return 1 / 0", "mine.py:2: ZeroDivisionError"),
    ],
)
def test_a_file_that_is_no_plugin_is_refused_in_one_line(tmp_path, refused, text, why):
    (tmp_path / "mine.py").write_text(text)
    assert why in refused("check mine.py")


@pytest.mark.parametrize(
    "given",
    [
        *("no.py", "no.txt", ".", "no.py --as predictor", "nobody --as executor"),
        *("nobody --as controller", "no.py --as metric", "readme.txt --as estimator"),
    ],
)
def test_what_is_neither_a_robot_nor_a_plugin_is_refused(tmp_path, refused, given):
    (tmp_path / "readme.txt").touch()
    assert refused(f"check {given}")
