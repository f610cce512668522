# SPDX-License-Identifier: Apache-2.0

"""What a flight shows of the paper's statements, by flights whose numbers are known."""

import pytest

from cloudrc.studies.reproduce.measures import measure
from cloudrc.wire.records import Arrival, Control
from tests.results.metrics.conftest import DOWNLINK, PERIOD, START, UPLINK, at, flown

CHANGE = 5.0
"""When the link changes [s since the start of the flight]."""


def measured(log, *changes):
    return measure(log.flight(), [START * 1e-9 + each for each in changes])


def late(log, seconds):
    """Let telemetry that is sent after the change arrive later by so much."""

    def arrive(_, row):
        if not row.uplink or row.stamp_ns - UPLINK * 1e9 < at(CHANGE):
            return row
        return row._replace(stamp_ns=row.stamp_ns + at(seconds) - START, delay=UPLINK + seconds)

    log.change(Arrival, arrive)
    return log


def steer(log, fields):
    """Let `fields(seconds)` be fields of each control period."""
    log.change(Control, lambda _, row: row._replace(**fields((row.stamp_ns - START) * 1e-9)))
    return log


def test_a_robot_that_never_flew_has_no_numbers():
    log = flown()
    log.keep(lambda stamp_ns: stamp_ns < START)
    assert measured(log) == {}


def test_delays_have_a_mean_and_half_of_a_range_in_each_part():
    found = measured(late(flown(), 0.1), CHANGE)
    mean, half = (UPLINK + DOWNLINK) / 2, (UPLINK - DOWNLINK) / 2
    before, after = found["one_way"]
    assert before == pytest.approx([mean, half])
    assert after == pytest.approx([mean + 0.05, half + 0.05], rel=0.02)
    assert [part[0] for part in found["round_trip"]] == pytest.approx([0.09, 0.19], rel=0.02)


def test_a_packet_that_is_under_way_as_the_link_changes_counts_in_neither_part():
    def arrive(_, row):
        sent = (row.stamp_ns - START) * 1e-9 - row.delay
        if not CHANGE - 0.1 < sent < CHANGE:
            return row
        return row._replace(stamp_ns=row.stamp_ns + at(0.3) - START, delay=row.delay + 0.3)

    log = flown()
    log.change(Arrival, arrive)
    halves = [half for _, half in measured(log, CHANGE)["one_way"]]
    assert halves == pytest.approx([(UPLINK - DOWNLINK) / 2] * 2)


def test_a_filter_has_the_spread_of_its_samples_and_of_its_estimate():
    log = steer(late(flown(), 0.1), lambda t: {"horizon": 0.08 if round(t / 0.04) % 2 else 0.06})
    found = measured(log)
    assert found["samples_sd"] == pytest.approx(0.05, rel=0.02)  # half of them are .1 s longer
    assert found["estimate_sd"] == pytest.approx(0.01, rel=0.02)
    assert "half_after" not in found


@pytest.mark.parametrize(("rate", "half"), [(0.025, 2.0), (0.005, None)])
def test_an_estimate_is_late_after_a_change(rate, half):
    """The samples rise from .13 to .23 s at once, the estimate by `rate` in a second."""
    base = UPLINK + DOWNLINK + PERIOD * 1e-9
    ramp = lambda t: {"horizon": base + rate * max(0.0, t - CHANGE)}  # noqa: E731
    found = measured(steer(late(flown(), 0.1), ramp), CHANGE)
    (after,) = found["half_after"]
    assert after == (None if half is None else pytest.approx(half, abs=0.05))
    assert found["behind"] == pytest.approx(0.1 - rate * CHANGE, abs=0.002)


def test_the_error_of_each_waypoint_has_a_peak_and_falls():
    """At 0, 4 and 8 s the setpoint is 1 m, 2 m and 3 m away; then 1 m/s, but the last stays."""

    def fields(t):
        waypoint = min(max(int(t // 4), 0), 2)
        away = (waypoint + 1.0) - (t - 4.0 * waypoint) * (waypoint < 2)
        return {
            "waypoint": waypoint,
            "measured": (0.0, 0.0, 1.0),
            "setpoint": (max(away, 0.02), 0.0, 1.0),
        }

    found = measured(steer(flown(), fields))
    assert found["peak"] == pytest.approx([1.0, 2.0, 3.0])
    assert found["fallen"] == [pytest.approx(0.9, abs=0.05), pytest.approx(1.8, abs=0.05), None]
    assert found["left"] == pytest.approx([0.02, 0.02])
