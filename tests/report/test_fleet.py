"""The report of a fleet: worst and median robot, and whether two would have met."""

from math import inf

import numpy as np
import pytest

from cloudrc.report.fleet import COLUMNS, RobotFlown, cell_rows, robot_rows, separation_min

NUMBERS = dict.fromkeys(COLUMNS, 0.1)


def path(*positions, start=0):
    stamps = start + np.arange(len(positions)) * 1_000_000_000
    return RobotFlown(0, {}, stamps, np.array(positions, float), (0.0, 0.0, 0.0))


def test_robots_count_as_near_once_one_of_them_is_away_from_the_spawn():
    one = path((0, 0, 0), (2, 0, 0), (2, 0, 0))
    other = path((0, 0, 0), (0, 2, 0), (2, 0.3, 0))
    assert separation_min([one, other]) == pytest.approx(0.3, abs=0.03)
    assert separation_min([one]) == inf
    assert separation_min([one, path((0, 0, 0), start=5_000_000_000)]) == inf


def test_of_many_robots_the_table_has_the_median_the_worst_and_those_that_failed():
    robots = [
        {"robot": k, "verdict": "failure", "failures": [f"code_{k}"], **NUMBERS} for k in range(12)
    ]
    robots[3] |= {"verdict": "success", "failures": []}
    document = {"robots": robots, "succeeded": 1, "median": NUMBERS, "worst": NUMBERS}
    rows = robot_rows(document, 10)
    assert [row[0] for row in rows] == ["robot", "median", "worst", *"012456789", "10"]
    assert rows[1][-1] == "1 of 12 succeeded"
    assert rows[3][1:3] == ["100", "100"]
    assert len(robot_rows(document)) == 15


def test_a_wait_without_a_theory_is_a_dash_and_an_endless_one_is_an_overload():
    keys = "load utilisation wait_mean wait_max waiting_max dropped"
    cell = dict.fromkeys(keys.split(), 0.5) | {"wait_mean_md1": None}
    (row,) = cell_rows({"cell": {"both": cell}})[1:]
    assert row[3:6] == ["500.00", "-", "overload"]
