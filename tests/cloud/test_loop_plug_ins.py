"""Plug-ins may raise and return anything: the control loop goes on."""

from collections import Counter
from math import inf, nan
from types import SimpleNamespace

import numpy as np
import pytest

from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.estimators import Estimator
from cloudrc.cloud.estimators.running_mean import RunningMean
from cloudrc.cloud.predictors import Predictor
from cloudrc.cloud.predictors.last_sample import LastSample
from cloudrc.drivers.process import from_line, to_line
from cloudrc.messages import ZERO
from tests.cloud.conftest import HERE, MS, Integrating, command, loop, telemetry


class Raising(Estimator, Predictor, Controller):
    def update(self, *arguments):
        raise RuntimeError("out of\nluck")

    horizon = observe = predict = update


class Leaving(Estimator, Predictor, Controller):
    def update(self, *arguments):
        raise SystemExit("enough")

    horizon = observe = predict = update


class Closing(Estimator, Predictor, Controller):
    def update(self, *arguments):
        raise GeneratorExit

    horizon = observe = predict = update


class Speechless(Estimator, Predictor, Controller):
    """Raises an exception without a text."""

    class Error(Exception):
        def __str__(self):
            raise SystemExit("no words")

    def update(self, *arguments):
        raise self.Error

    horizon = observe = predict = update


class OutOfShape(Estimator, Predictor, Controller):
    def horizon(self, age):
        return (0.1,)

    def predict(self, odometry, horizon):
        return odometry._replace(position=(1.0, 2.0), velocity=(0.0, 0.0, 0.0, 0.0))

    def update(self, *arguments):
        return ControlOutput((0.1, 0.2), 0.0, proportional=(1.0, 2.0, 3.0, 4.0))


class NotFinite(Estimator, Predictor, Controller):
    def horizon(self, age):
        return nan

    def predict(self, odometry, horizon):
        return odometry._replace(position=(inf, 0.0, 0.0))

    def update(self, *arguments):
        return ControlOutput((0.0, nan, 0.0), 0.0)


@pytest.mark.parametrize("bad", [Raising, Leaving, Closing, Speechless, OutOfShape, NotFinite])
@pytest.mark.parametrize("kind", ["estimator", "predictor", "controller"])
def test_a_failing_plug_in_is_counted_and_reported_once(kind, bad):
    broken = {kind: bad if kind == "estimator" else bad()}
    a_loop = loop(**broken)
    for k in range(3):
        a_loop.observe(telemetry(100 + 10 * k), (1090 + 10 * k) * MS)
        sent, control = command(a_loop, 1094 + 10 * k)
    assert control.position == HERE  # the last sample, not moved
    assert sent.velocity == (ZERO if kind == "controller" else pytest.approx((0.8, 0.0, 0.0)))
    assert a_loop.counts[f"{kind}_failed"] >= 3
    (fault,) = a_loop.take_faults()
    assert fault.code == f"{kind}_failed"
    assert "\n" not in fault.text
    assert f"fix cloud.{kind}" in fault.text


ANY = ControlOutput((0.1, 0.2, 0.3), 0.4, ZERO, ZERO, ZERO)


@pytest.mark.parametrize("field", ["velocity", "proportional", "integral", "derivative"])
@pytest.mark.parametrize("wrong", [(0.1, 0.2), (0.1, 0.2, 0.3, 0.4), "abc", None, (None,) * 3])
def test_an_output_that_is_not_three_numbers_is_not_flown(field, wrong):
    class Odd(Controller):
        def update(self, *arguments):
            return ANY._replace(**{field: wrong})

    a_loop = loop(controller=Odd())
    a_loop.observe(telemetry(100), 1090 * MS)
    assert command(a_loop, 1094)[0].velocity == ZERO
    assert a_loop.counts["controller_failed"] == 1


def test_an_output_without_its_terms_is_not_flown():
    class Bare(Controller):
        def update(self, *arguments):
            return SimpleNamespace(velocity=(0.1, 0.2, 0.3), yaw_rate=0.0)

    a_loop = loop(controller=Bare())
    a_loop.observe(telemetry(100), 1090 * MS)
    assert command(a_loop, 1094)[0].velocity == ZERO


def test_arrays_and_generators_become_plain_numbers():
    class Arrays(Estimator, Predictor, Controller):
        def horizon(self, age):
            return np.float32(0.5)

        def update(self, *arguments):
            return ANY._replace(velocity=np.array([1, 2, 3]), integral=(n for n in (4, 5, 6)))

        def predict(self, odometry, horizon):
            return odometry._replace(position=np.array(odometry.position, np.float32))

    a_loop = loop(Arrays, Arrays(), Arrays())
    a_loop.observe(telemetry(100), 1090 * MS)
    sent, control = command(a_loop, 1094)
    assert sent.velocity == (1.0, 2.0, 3.0)
    assert (control.horizon, control.position, control.integral) == (0.5, HERE, (4.0, 5.0, 6.0))
    assert str(from_line(to_line(control))) == str(control)


def test_a_failing_reset_is_reported_with_the_next_telemetry():
    times = Counter()

    class Once:
        """Begins once, and again raises."""

        def reset(self):
            times[type(self)] += 1
            if times[type(self)] > 1:
                raise RuntimeError("not again")

    class Mean(Once, RunningMean):
        def __init__(self):
            self.reset()
            super().__init__()

    class Sample(Once, LastSample):
        pass

    class Steady(Once, Integrating):
        pass

    a_loop = loop(Mean, Sample(), Steady())
    a_loop.start_mission()
    a_loop.reset()
    assert a_loop.take_faults() == []
    a_loop.observe(telemetry(100, echo_ms=1000), 1090 * MS)
    sent, control = command(a_loop, 1094)
    assert (sent.velocity, control.horizon) == ((1.0, 0.0, 0.0), 0.0)
    faults = {fault.code: (fault.stamp_ns, fault.text) for fault in a_loop.take_faults()}
    assert set(faults) == {"estimator_failed", "predictor_failed", "controller_failed"}
    assert {stamp_ns for stamp_ns, _ in faults.values()} == {1090 * MS}
    assert "cloud goes on using it" in faults["controller_failed"][1]


def test_ctrl_c_in_a_plug_in_ends_the_program():
    class Interrupted(Controller):
        def update(self, *arguments):
            raise KeyboardInterrupt

    a_loop = loop(controller=Interrupted())
    a_loop.observe(telemetry(100), 1090 * MS)
    with pytest.raises(KeyboardInterrupt):
        command(a_loop, 1094)


def test_a_long_error_of_a_plug_in_is_cut_to_one_line():
    class Verbose(Controller):
        def update(self, *arguments):
            raise ValueError("no caf\udce9 " + "x" * 100_000)

    a_loop = loop(controller=Verbose())
    a_loop.observe(telemetry(100), 1090 * MS)
    command(a_loop, 1094)
    (fault,) = a_loop.take_faults()
    assert "ValueError: no caf\\udce9 xxx" in fault.text
    assert len(fault.text.encode()) < 2200
    assert fault.text.endswith("fix cloud.controller or choose another")
