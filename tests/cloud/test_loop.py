# SPDX-License-Identifier: Apache-2.0

"""The control loop: delays, when it freezes, and that it goes on whatever a plug-in does."""

from functools import partial
from math import inf, nan

import pytest

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.estimators import Estimator
from cloudrc.cloud.estimators.running_mean import RunningMean
from cloudrc.cloud.predictors import Predictor
from cloudrc.cloud.predictors.last_sample import LastSample
from cloudrc.wire.messages import ZERO
from tests.cloud.conftest import HERE, MS, Integrating, command, loop, telemetry

ONE = (1.0, 0.0, 0.0)


# Delays


def test_a_command_names_its_basis_and_its_delays():
    a_loop = loop()
    a_loop.observe(telemetry(100, echo_ms=1000, hold_ms=7), 1090 * MS)
    sent, control = command(a_loop, 1094)
    assert (sent.basis_stamp_ns, sent.basis_hold_ns) == (100 * MS, 4 * MS)
    assert sent.velocity == pytest.approx((0.8, 0.0, 0.0))  # published gain, 1 m away
    assert control.loop_delay == control.horizon == pytest.approx(0.090)
    assert control.rtt == pytest.approx(0.083)


@pytest.mark.parametrize(("hold_ms", "horizon_ms"), [(0, 90), (50, 140), (51, 90)])
def test_each_telemetry_is_a_sample_while_its_echo_is_fresh(hold_ms, horizon_ms):
    """While the downlink is silent, world echoes the same command with a growing hold."""
    a_loop = loop(estimator=partial(RunningMean, 1), heard_ms=1090, echo_ms=1000)
    a_loop.observe(telemetry(100 + hold_ms, 1000, hold_ms), (1090 + hold_ms) * MS)
    assert command(a_loop, 1150)[1].horizon == pytest.approx(horizon_ms * 1e-3)


def test_each_applied_command_counts_once_also_in_late_telemetry():
    differences, told = [], []

    class Listening(Estimator, LastSample):
        def add_applied(self, applied_minus_stamp):
            differences.append(round(applied_minus_stamp * 1e3))

        def applied(self, command_stamp_ns, applied_ns):
            told.append((command_stamp_ns // MS, applied_ns // MS))

    a_loop = loop(Listening, Listening(), heard_ms=1090, echo_ms=1000)  # world's clock is behind
    a_loop.observe(telemetry(120, echo_ms=1020, hold_ms=2), 1110 * MS)
    a_loop.observe_late(telemetry(110, echo_ms=1005, hold_ms=1), 1115 * MS)
    a_loop.observe(telemetry(130, echo_ms=1020, hold_ms=12), 1120 * MS)
    assert differences == [-900, -902, -896]
    assert told == [(1000, 100), (1020, 118), (1005, 109)]


@pytest.mark.parametrize(
    ("horizon", "limit", "clamped"), [(3.0, 1.0, 1.0), (3.0, 2.0, 2.0), (-0.5, 1.0, 0.0)]
)
def test_a_horizon_out_of_range_is_clamped_and_counted(horizon, limit, clamped):
    a_loop = loop(estimator=returns(horizon), heard_ms=1090, horizon_max=limit)
    assert command(a_loop, 1094)[1].horizon == clamped
    assert a_loop.counts == {"horizon_clamped": 1}


def test_a_new_session_forgets_what_was_measured():
    a_loop = loop(heard_ms=1090, echo_ms=1000)
    a_loop.reset(1100 * MS)
    assert not a_loop.ready
    a_loop.observe(telemetry(200), 1190 * MS)
    assert command(a_loop, 1194)[1].horizon == 0.0


# The frozen loop


def test_a_silent_echo_freezes_after_horizon_plus_400_ms():
    controller = Integrating()
    a_loop = loop(controller=controller, heard_ms=1100, echo_ms=1000)
    assert command(a_loop, 1500)[0].velocity == ONE  # a horizon of 100 ms
    assert command(a_loop, 1501)[0][3:5] == (ZERO, 0.0)
    assert (a_loop.counts["frozen"], controller.asked) == (1, 1)
    # Telemetry alone does not help, an echo does.
    a_loop.observe(telemetry(500, echo_ms=1000, hold_ms=400), 1510 * MS)
    assert command(a_loop, 1510)[0].velocity == ZERO
    a_loop.observe(telemetry(510, echo_ms=1420), 1520 * MS)
    assert command(a_loop, 1520)[0].velocity == ONE


def test_a_loop_waits_for_an_echo_as_long_as_configured():
    a_loop = loop(controller=Integrating(), heard_ms=1100, echo_ms=1000, freeze_after=0.8)
    assert [command(a_loop, now_ms)[0].velocity for now_ms in (1900, 1901)] == [ONE, ZERO]
    # Before the first echo, the wait begins with the first command, and again with a mission.
    a_loop = loop(controller=Integrating(), heard_ms=1100)
    flown = [command(a_loop, now_ms)[0].velocity for now_ms in (2000, 2400, 2401)]
    assert flown == [ONE, ONE, ZERO]
    a_loop.start_mission()
    assert command(a_loop, 2410)[0].velocity == ONE


# Plug-ins may raise and return anything.


def raises(error):
    """Make a plug-in of every kind that raises an error."""

    class Bad(Estimator, Predictor, Controller):
        def update(self, *arguments):
            raise error

        horizon = observe = predict = applied = update

    return Bad


def returns(horizon=0.0, output=None, **changes):
    """Make a plug-in of every kind that returns something, the odometry with changes."""

    class Odd(Estimator, Predictor, Controller):
        def horizon(self, age):
            return horizon

        def predict(self, odometry, horizon):
            return odometry._replace(**changes)

        def update(self, *arguments):
            return output

    return Odd


ERRORS = RuntimeError("out of\nluck"), StopIteration, SystemExit("enough"), RecursionError
LONG = ValueError("no caf\udce9 " + "x" * 100_000)
ANY = ControlOutput((0.1, 0.2, 0.3), 0.4, ZERO, ZERO, ZERO)
OUT_OF_SHAPE = returns((0.1,), ANY._replace(velocity=(0.1, 0.2)), position=(1.0, 2.0))
NOT_FINITE = returns(nan, ANY._replace(velocity=(0.0, nan, 0.0)), position=(inf, 0.0, 0.0))
NO_NUMBERS = returns("abc", ANY._replace(integral=(None,) * 3), velocity="abc")


@pytest.mark.parametrize(
    "bad", [*map(raises, (*ERRORS, LONG)), OUT_OF_SHAPE, NOT_FINITE, NO_NUMBERS]
)
@pytest.mark.parametrize("kind", ["estimator", "predictor", "controller"])
def test_a_failing_plug_in_is_counted_and_reported_once(kind, bad):
    a_loop = loop(**{kind: bad if kind == "estimator" else bad()})
    for k in range(3):
        a_loop.observe(telemetry(100 + 10 * k, 1000 + 10 * k), (1090 + 10 * k) * MS)
        sent, control = command(a_loop, 1094 + 10 * k)
    assert control.position == HERE  # the last sample, not moved
    assert sent.velocity == (ZERO if kind == "controller" else pytest.approx((0.8, 0.0, 0.0)))
    assert a_loop.counts[f"{kind}_failed"] >= 3
    (fault,) = a_loop.take_faults()
    assert fault.code == f"{kind}_failed"
    assert "\n" not in fault.text
    assert len(fault.text.encode()) < 2200
    assert len(fault.traceback.encode()) < 6200
    assert fault.text.endswith(f"fix cloud.{kind} or choose another")
