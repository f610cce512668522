"""The control loop: delays from telemetry, and when the loop freezes."""

import pytest

from cloudrc.cloud.estimators import Estimator
from cloudrc.cloud.estimators.split import build as split
from cloudrc.cloud.predictors import Predictor
from cloudrc.messages import ZERO
from tests.cloud.conftest import MS, Integrating, command, loop, telemetry


def test_round_trip_and_loop_delay_differ_by_the_hold():
    a_loop = loop()
    a_loop.observe(telemetry(100, echo_ms=1000, hold_ms=7), 1090 * MS)
    _, control = command(a_loop, 1092)
    assert control.loop_delay == pytest.approx(0.090)
    assert control.rtt == pytest.approx(0.083)
    assert control.horizon == pytest.approx(0.090)


def test_a_command_names_its_basis_and_how_long_it_was_held():
    a_loop = loop()
    a_loop.observe(telemetry(100), 1090 * MS)
    sent, _ = command(a_loop, 1094)
    assert (sent.basis_stamp_ns, sent.basis_hold_ns) == (100 * MS, 4 * MS)
    assert sent.velocity == pytest.approx((0.8, 0.0, 0.0))  # published gain, 1 m away


def test_a_repeated_echo_is_no_sample():
    """While the downlink is silent, world echoes the same command with a growing age."""
    a_loop = loop()
    a_loop.observe(telemetry(100, echo_ms=1000), 1090 * MS)
    for k in range(1, 2000):
        a_loop.observe(telemetry(100 + 10 * k, echo_ms=1000, hold_ms=10 * k), (1090 + 10 * k) * MS)
    _, control = command(a_loop, 21_090)
    assert control.horizon == pytest.approx(0.090)


def test_split_counts_how_long_cloud_has_held_the_odometry():
    a_loop = loop(estimator=split)
    # Applied at 95 ms of world's clock, 5 ms before the odometry, sent at 1000 ms of cloud's.
    a_loop.observe(telemetry(100, echo_ms=1000, hold_ms=5), 1090 * MS)
    _, control = command(a_loop, 1093)
    assert control.horizon == pytest.approx((1093 - 100 + 95 - 1000) * 1e-3)


@pytest.mark.parametrize(("horizon", "clamped"), [(3.0, 1.0), (-0.5, 0.0)])
def test_a_horizon_out_of_range_is_clamped_and_counted(horizon, clamped):
    class Wild(Estimator):
        def update(self, sample):
            pass

        def horizon(self, age):
            return horizon

    a_loop = loop(estimator=Wild)
    a_loop.observe(telemetry(100), 1090 * MS)
    _, control = command(a_loop, 1094)
    assert control.horizon == clamped
    assert a_loop.counts["horizon_clamped"] == 1


def test_a_silent_echo_freezes_after_horizon_plus_400_ms():
    controller = Integrating()
    a_loop = loop(controller=controller)
    a_loop.observe(telemetry(100, echo_ms=1000), 1100 * MS)  # a horizon of 100 ms
    assert command(a_loop, 1500)[0].velocity == (1.0, 0.0, 0.0)
    assert command(a_loop, 1501)[0][3:] == (ZERO, 0.0)
    assert a_loop.counts["frozen"] == 1
    assert controller.asked == 1
    # Telemetry alone does not help, an echo does.
    a_loop.observe(telemetry(500, echo_ms=1000, hold_ms=400), 1510 * MS)
    assert command(a_loop, 1510)[0].velocity == ZERO
    a_loop.observe(telemetry(510, echo_ms=1420), 1520 * MS)
    assert command(a_loop, 1520)[0].velocity == (1.0, 0.0, 0.0)


def test_the_first_echo_has_as_much_time():
    a_loop = loop(controller=Integrating())
    a_loop.observe(telemetry(100), 1100 * MS)
    assert command(a_loop, 2000)[0].velocity == (1.0, 0.0, 0.0)
    assert command(a_loop, 2400)[0].velocity == (1.0, 0.0, 0.0)
    assert command(a_loop, 2401)[0].velocity == ZERO
    a_loop.start_mission()
    assert command(a_loop, 2410)[0].velocity == (1.0, 0.0, 0.0)


def test_while_frozen_the_predictor_gets_commands_of_zero():
    told = []

    class Listening(Predictor):
        def predict(self, odometry, horizon):
            return odometry

        def commanded(self, command):
            told.append(command.velocity)

    a_loop = loop(predictor=Listening(), controller=Integrating())
    a_loop.observe(telemetry(100, echo_ms=1000), 1100 * MS)
    command(a_loop, 1200)
    command(a_loop, 1600)
    assert told == [(1.0, 0.0, 0.0), ZERO]


def test_a_new_session_forgets_what_was_measured():
    a_loop = loop()
    a_loop.observe(telemetry(100, echo_ms=1000), 1090 * MS)
    a_loop.reset()
    assert not a_loop.ready
    a_loop.observe(telemetry(200), 1190 * MS)
    _, control = command(a_loop, 1194)
    assert control.horizon == 0.0
