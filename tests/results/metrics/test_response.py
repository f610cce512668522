# SPDX-License-Identifier: Apache-2.0

"""The response to steps: against second-order systems, whose overshoot and settling are known."""

from math import cos, exp, pi, sin, sqrt

import pytest

from cloudrc.config.schema import MissionConfig, Steps
from cloudrc.results.metrics.response import responses, steps
from cloudrc.wire.records import Control, MissionEvent
from tests.results.metrics.conftest import SECOND, START, at, flown, judged, measured


def second_order(damping):
    """Return the position [m] over time [s] of a step by 1 m along x at t = 0, with 3 rad/s."""
    root = sqrt(1 - damping**2)

    def path(t):
        phase = 3.0 * root * max(t, 0.0)
        decay = exp(-damping * 3.0 * max(t, 0.0))
        return 1 - decay * (cos(phase) + damping / root * sin(phase)), 0.0, 1.0

    return path


def growing(t):
    return 1 - exp(0.1 * t) * cos(3 * t), 0.0, 1.0


def flight(path, setpoint=lambda t: (1.0, 0.0, 1.0), **conditions):
    log = flown(path)
    log.change(Control, lambda n, c: c._replace(setpoint=setpoint((c.stamp_ns - START) / SECOND)))
    return log.flight(**conditions)


def failures(a_flight):
    return {failure.code: failure.text for failure in judged(a_flight, {}).failures}


@pytest.mark.parametrize("damping", [0.2, 0.8])
def test_a_step_of_a_second_order_system(damping):
    (step,) = steps(flight(second_order(damping)))
    assert (step.start, step.length) == (0.0, 1.0)
    assert step.overshoot == pytest.approx(exp(-pi * damping / sqrt(1 - damping**2)), abs=0.005)
    path = second_order(damping)
    outside = [t for t in (n / 1000 for n in range(10_000)) if abs(path(t)[0] - 1.0) > 0.05]
    assert step.settling_time == pytest.approx(outside[-1], abs=0.05)
    # Integral of the squared error of a unit step: (1 + 4 damping^2) / (4 damping 3 rad/s).
    assert step.ise == pytest.approx((1 + 4 * damping**2) / (12 * damping), rel=0.03)
    cost = measured(flight(path), "control_cost")
    assert cost == pytest.approx(step.ise, rel=0.02)
    assert step.last_error < 0.05
    assert not step.unstable


def test_the_squared_command_is_integrated_over_each_step():
    """Commands of (1, 2, 2) m/s until 4 s, then of (0, 0, -1) m/s; the mean is over both steps."""
    log = flown(lambda t: (1.0 if t < 4.0 else 3.0, 0.0, 1.0))

    def command(n, period):
        early = period.stamp_ns < at(4.0)
        setpoint = (2.0, 0.0, 1.0) if early else (4.0, 0.0, 1.0)
        return period._replace(
            setpoint=setpoint, command=(1.0, 2.0, 2.0) if early else (0.0, 0.0, -1.0)
        )

    log.change(Control, command)
    mean = measured(log.flight(), "squared_command_integral_mean")
    assert mean == pytest.approx((9.0 * 4.0 + 1.0 * 6.0) / 2, rel=0.02)


@pytest.mark.parametrize("path", [growing, second_order(0.0)])
def test_an_oscillation_without_decay_is_unstable(path):
    assert "unstable" in failures(flight(path))


def test_a_small_or_decaying_oscillation_is_stable():
    def shaking(t):
        return 1.0 - exp(-t) + 0.1 * sin(5 * t), 0.0, 1.0

    assert [step.unstable for step in steps(flight(shaking))] == [False]
    assert measured(flight(second_order(0.1)), "unstable_steps") == 0.0


def test_a_changed_setpoint_begins_a_step_a_moving_one_does_not():
    two = steps(flight(second_order(0.5), lambda t: (1.0 if t < 4 else 2.0, 0.0, 1.0)))
    assert [(step.start, round(step.length, 2)) for step in two] == [(0.0, 1.0), (4.0, 1.0)]
    assert two[1].settling_time is None, "it never went there"
    assert two[1].last_error == pytest.approx(1.0, abs=0.01)
    assert steps(flight(second_order(0.5), lambda t: (0.1 * t, 0.0, 1.0))) == ()


def test_the_end_of_a_moving_setpoint_is_judged_but_is_no_step():
    """The robot swings about the place where the setpoint stops, 0.1 m ahead of the robot."""

    def stopping(t):
        return min(t, 3.0), 0.0, 1.0

    def path(t):
        return (
            t - 0.1 if t < 3.0 else 3.0 - 0.1 * exp(0.5 * (t - 3.0)) * cos(3 * (t - 3.0)),
            0.0,
            1.0,
        )

    ended = flight(path, stopping)
    assert steps(ended) == ()
    assert [round(each.length, 2) for each in responses(ended)] == [0.1]
    assert measured(ended, "unstable_steps") == 1.0
    assert "unstable" in failures(ended)


def test_random_steps_must_settle_and_null_switches_it_off():
    far = second_order(0.5), lambda t: (1.3, 0.0, 1.0)
    mission = MissionConfig(steps=Steps(count=1))
    text = failures(flight(*far, mission=mission))["not_settled"]
    assert "in step 1 the robot was 0.3 m from the setpoint" in text
    assert "criteria.settle_m 0.15 m" in text
    assert "not_settled" not in failures(flight(*far, mission=mission, settle_m=None))


@pytest.mark.parametrize("ending", ["timed_out", None])
def test_a_step_whose_end_was_not_flown_has_neither_settled_nor_failed_to(ending):
    """The second step begins 1.5 s before the end of the flight; then the robot has to stop."""
    log, mission = flown(second_order(0.7)), MissionConfig(steps=Steps(count=2))

    def aim(_, row):
        if ending and row.stamp_ns >= at(9.99):
            return row._replace(setpoint=(1.1, 0, 1), waypoint=-1)
        return row._replace(setpoint=(1.0 if row.stamp_ns < at(8.5) else 2, 0, 1), waypoint=0)

    def end(_, event):
        return event if event.event != "done" else ending and event._replace(event=ending)

    log.change(Control, aim)
    done = log.flight(mission=mission)
    assert failures(done)["not_settled"].startswith("1 of 2 steps")
    log.change(MissionEvent, end)
    cut = log.flight(mission=mission)
    assert "not_settled" not in failures(cut)
    assert [measured(each, "unsettled_steps") for each in (done, cut)] == [1.0, 0.0]
    assert measured(flight(growing), "settling_time_mean") is None
