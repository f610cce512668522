# SPDX-License-Identifier: Apache-2.0

"""Each function of a user's file is called in one guard: its failure is one error with its line."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.robots.build import check_robot
from cloudrc.robots.check import check

SPHERES = """
def few():
    return [[0.0, 0.0, 0.0, 0.3]]
"""
ONBOARD = "from cloudrc.robots.pelican.onboard import actuators, build\n"
FUNCTIONS = {
    "few": "hull.py",
    "accelerator": "own.py",
    "advise": "own.py",
    "actuators": "own.py",
}
"""Function of a robot's files that cloudrc calls -> its file; `build` has tests of its own."""


@pytest.fixture
def failing(own_robot):
    """Return a function that writes a robot of which one function has another body."""

    def write(function, body, arguments="*given, **named"):
        mine = own_robot("onboard: ./own.py\nhull_points: ./hull.py")
        sources = {"hull.py": SPHERES, "own.py": ONBOARD}
        sources[FUNCTIONS[function]] += f"\ndef {function}({arguments}):\n    {body}\n"
        for name, source in sources.items():
            (mine / name).write_text(source)
        return mine

    return write


def refusals(mine):
    """Return the errors with which a flight and the check of the robot refuse it."""
    texts = []

    def fly():
        check_robot(load_experiment("hover", [f"world.robot={mine}", "world.scene=empty"]).world)

    for look in (fly, lambda: check(str(mine))):
        with pytest.raises(BadInputError) as caught:
            look()
        assert caught.value.exit_code == 2
        texts.append(str(caught.value))
    return texts


@pytest.mark.parametrize("function", FUNCTIONS)
def test_a_failure_of_any_function_is_one_error_with_file_and_line(failing, function):
    mine = failing(function, "return 1 / 0")
    file = mine / FUNCTIONS[function]
    line = file.read_text().splitlines().index("    return 1 / 0") + 1
    for text in refusals(mine):
        assert f"{file}: {function}() failed: {file.name}:{line}: ZeroDivisionError" in text


def test_what_a_function_returns_is_checked_before_the_flight(failing):
    mine = failing("few", "return [[0, 0, 0, float('nan')]]")
    for text in refusals(mine):
        assert f"{mine / 'hull.py'}:" in text
        assert "at [0, 3] is nan, not a finite number" in text
