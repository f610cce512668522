# SPDX-License-Identifier: Apache-2.0

"""The report of a fleet: worst and median robot, and whether two would have met."""

import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.link.cell import Usage
from cloudrc.results.report.fleet import FleetFlown, fleet_document, separation_min, tables

NUMBERS = {"age_ms": 100.0, "hold_s": 0.5}
SPAWN = (0.0, 0.0, 0.1)


def test_robots_count_as_near_once_one_of_them_is_away_from_the_spawn():
    one = np.array([(0, 0, 0), (2, 0, 0), (2, 0, 0)], float)
    other = np.array([(0, 0, 0), (0, 2, 0), (2, 0.3, 0), (2, 0, 0)], float)
    assert separation_min([one, other], SPAWN) == pytest.approx(0.3)
    assert separation_min([one], SPAWN) is separation_min([one[:1], other], SPAWN) is None


def test_of_many_robots_the_table_has_the_median_the_worst_and_those_that_failed():
    robots = [{"robot": k, "verdict": "failure", "why": f"code_{k}", **NUMBERS} for k in range(12)]
    robots[3] = {"robot": 3, "verdict": "success", **NUMBERS}
    document = {"robots": robots, "median": NUMBERS, "worst": NUMBERS, "cell": []}
    (rows,) = tables(document, 10)
    assert [row[0] for row in rows] == ["robot", "median", "worst", *"012456789", "10"]
    assert rows[3] == ("0", "100", "0.50", "failure", "code_0")
    (rows,) = tables(document)
    assert len(rows) == 15


def test_a_wait_without_end_is_a_dash_and_a_column_without_any_number_is_left_out():
    names = "load utilisation wait_mean_ms wait_max_ms waiting_max dropped"
    cell = dict.fromkeys(names.split(), 0.5) | {"direction": "uplink", "md1_ms": None}
    cells = [cell, cell | {"md1_ms": 3}]
    _, rows = tables({"robots": [], "median": {}, "worst": {}, "cell": cells})
    assert [row[4] for row in rows] == ["M/D/1 [ms]", "-", "3.00"]


@pytest.mark.parametrize(
    ("experiment", "is_known"), [("steps", True), ("follow", False), ("gap", False)]
)
def test_the_wait_of_periodic_senders_is_told_of_robots_that_send_telemetry_alone(
    experiment, is_known
):
    used = Usage("uplink", time_s=1.0, packets=100, size=23_200, busy_ns=185_600_000)
    flown = FleetFlown(load_experiment(experiment, ["cell.rate_kbit=1000"]), log=[used])
    flown.robots = [{"robot": 0, "verdict": "success"}]
    (cell,) = fleet_document(flown)["cell"]
    assert ("nddd1_ms" in cell) is is_known
