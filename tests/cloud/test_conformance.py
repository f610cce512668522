# SPDX-License-Identifier: Apache-2.0

"""Check every plug-in file against the contract of its kind."""

import importlib
import inspect
import pkgutil
from math import inf, isfinite, pi, sqrt

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.cloud import controllers, estimators, perceptions, predictors
from cloudrc.cloud.controllers import Controller, ControlOutput
from cloudrc.cloud.estimators import DelaySample, Estimator
from cloudrc.cloud.perceptions import Frame, Perception, Scan
from cloudrc.cloud.predictors import Predictor
from cloudrc.config.overrides import OUTSIDE
from cloudrc.wire.messages import UPRIGHT, ZERO, Command, Odometry, Setpoint
from tests.support.robots import facts_of

PELICAN, X2 = facts_of("pelican", 12.0), facts_of("x2", 4.0)
KINDS = {
    estimators: Estimator,
    predictors: Predictor,
    controllers: Controller,
    perceptions: Perception,
}


def discover(package):
    return [
        importlib.import_module(f"{package.__name__}.{found.name}")
        for found in pkgutil.iter_modules(package.__path__)
        if not found.name.startswith("_")
    ]


def short(module):
    return module.__name__.removeprefix("cloudrc.cloud.")


PLUGINS = [(module, kind) for package, kind in KINDS.items() for module in discover(package)]
every_plugin = pytest.mark.parametrize(
    ("module", "kind"), PLUGINS, ids=[short(module) for module, _ in PLUGINS]
)
every_estimator = pytest.mark.parametrize("module", discover(estimators), ids=short)
every_perception = pytest.mark.parametrize("module", discover(perceptions), ids=short)
every_predictor = pytest.mark.parametrize("module", discover(predictors), ids=short)
OWN = [
    module for module in discover(controllers) if module.__name__.rpartition(".")[2] not in OUTSIDE
]
"""Controllers that compute commands themselves; the others ask a program."""
every_controller = pytest.mark.parametrize("module", OWN, ids=short)
fewer = settings(max_examples=20, deadline=None)

numbers = st.floats(-1e6, 1e6)
vectors = st.tuples(numbers, numbers, numbers)
delays = st.floats(0.0, 10.0)
samples = st.builds(DelaySample, delays, delays)
axes = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(c * c for c in q) > 1e-3)
quaternions = axes.map(lambda q: tuple(c / sqrt(sum(c * c for c in q)) for c in q))
stamps = st.integers(0, 10**15)
odometry = st.builds(Odometry, stamps, vectors, quaternions, vectors, vectors)
plans = st.lists(vectors, max_size=5).map(tuple)
commands = st.builds(Command, stamps, stamps, st.just(0), vectors, numbers, plans, stamps)
yaws = st.floats(-10 * pi, 10 * pi)
setpoints = st.builds(Setpoint, vectors, yaws, velocity=vectors, yaw_rate=numbers)


def are_finite(*values):
    return all(isfinite(number) for value in values for number in value)


def build(module):
    """Build a plug-in with its defaults, for the Pelican; a perception for x2, which turns."""
    takes = "robot" in inspect.signature(module.build).parameters
    robot = X2 if "perceptions" in module.__name__ else PELICAN
    return module.build(**({"robot": robot} if takes else {}))


@every_plugin
def test_a_plugin_is_built_and_documented_as_the_contract_says(module, kind):
    signature = inspect.signature(module.build, eval_str=True)
    for name, parameter in signature.parameters.items():
        assert parameter.annotation is not parameter.empty, parameter
        if parameter.kind is parameter.VAR_KEYWORD:
            name = f"**{name}"
        else:
            assert parameter.default is not parameter.empty, parameter
        assert f"    {name}: " in inspect.getdoc(module.build)
    assert isinstance(build(module), kind)
    assert build(module) is not build(module)
    assert "Source:" in module.__doc__


@every_estimator
@given(given_samples=st.lists(samples, max_size=30), age=numbers)
@fewer
def test_horizon_begins_at_zero_and_stays_finite_and_positive(module, given_samples, age):
    estimator = build(module)
    assert estimator.horizon(age) == 0.0
    for sample in given_samples:
        estimator.update(sample)
        estimator.add_applied(age - sample.rtt)
        assert 0.0 <= estimator.horizon(age) < float("inf")


@every_estimator
@given(uplink=st.floats(0, 0.5), downlink=st.floats(0, 0.5), hold=st.floats(0, 0.01))
@fewer
def test_horizon_of_a_constant_loop_is_its_delay(module, uplink, downlink, hold):
    """It may include the hold on the robot, as the paper's tau_n does, but nothing more."""
    estimator, offset, rtt = build(module), 3.0, uplink + downlink
    for _ in range(300):
        estimator.update(DelaySample(rtt + hold, rtt))
        estimator.add_applied(downlink - offset)
    assert rtt - 1e-9 <= estimator.horizon(uplink + offset) <= rtt + hold + 1e-9


@every_predictor
@given(
    history=st.lists(odometry, min_size=1, max_size=10),
    command=commands,
    horizon=st.floats(0.0, 1.0),
)
@fewer
def test_a_prediction_is_finite_later_and_a_rotation(module, history, command, horizon):
    predictor = build(module)
    for sample in sorted(history, key=lambda sample: sample.stamp_ns):
        predictor.observe(sample)
    predictor.commanded(command._replace(planned_ns=sample.stamp_ns))
    predictor.applied(command.stamp_ns, sample.stamp_ns)
    assert predictor.predict(sample, 0.0) == sample
    prediction = predictor.predict(sample, horizon)
    assert prediction.stamp_ns == sample.stamp_ns + round(horizon * 1e9)
    assert are_finite(prediction.position, prediction.velocity, prediction.angular_velocity_body)
    assert sum(c * c for c in prediction.orientation_wxyz) == pytest.approx(1.0)
    assert predictor.predict(sample, horizon) == prediction


@every_predictor
def test_a_predictor_forgets_everything_when_it_is_reset(module):
    used, fresh = build(module), build(module)
    for k in range(20):
        used.observe(Odometry(k * 10**7, ZERO, UPRIGHT, (0.1 * k * k, -k, 2.0), (1.0, 2.0, 3.0)))
        used.commanded(Command(k, k, 0, (1.0, 2.0, 3.0), 0.5))
        used.applied(k, k * 10**7)
    used.reset()
    # The stamps of a new session may begin anywhere, even earlier.
    for k in range(5):
        sample = Odometry(k * 10**7, ZERO, UPRIGHT, (0.2 * k, 0.0, 1.0), ZERO)
        used.observe(sample)
        fresh.observe(sample)
        assert used.predict(sample, 0.1) == fresh.predict(sample, 0.1)


@every_predictor
def test_a_model_continues_from_the_last_prediction(module):
    predictor = build(module)
    sample = Odometry(10**9, (1.0, 2.0, 3.0), UPRIGHT, (1.0, 0.0, 0.0), ZERO)
    predictor.observe(sample)
    predictor.commanded(Command(10**8, 10**9, 0, (2.0, 0.0, 0.0), 0.0))
    predictor.applied(10**8, 10**9)
    prediction, model = predictor.predict(sample, 0.2), predictor.model()
    if model is None:
        return
    still = model.step((2.0, 0.0, 0.0), 0.01)
    assert still.stamp_ns == prediction.stamp_ns + 10**7
    assert still.position == pytest.approx(prediction.position, abs=0.03)
    for _ in range(500):
        end = model.step((0.0, 1.0, 0.0), 0.01)
    assert end.velocity == pytest.approx((0.0, 1.0, 0.0), abs=0.05)
    # A new model begins anew, and predictions do not change.
    assert predictor.model().step((2.0, 0.0, 0.0), 0.01) == still
    assert predictor.predict(sample, 0.2) == prediction


@every_controller
@given(estimates=st.lists(odometry, min_size=1, max_size=10), setpoint=setpoints)
@fewer
def test_a_command_is_finite(module, estimates, setpoint):
    controller = build(module)
    for estimate in estimates:
        output = controller.update(estimate, setpoint, 0.01)
        assert isinstance(output, ControlOutput)
        assert are_finite(output.velocity, (output.yaw_rate,))
        assert are_finite(output.proportional, output.integral, output.derivative)


@every_controller
@given(position=vectors, axis=st.sampled_from(range(3)), way=st.sampled_from([-1.0, 0.0, 1.0]))
@fewer
def test_a_command_leads_towards_the_setpoint(module, position, axis, way):
    wanted = tuple(p + way * (index == axis) for index, p in enumerate(position))
    estimate = Odometry(0, position, UPRIGHT, ZERO, ZERO)
    velocity = build(module).update(estimate, Setpoint(wanted), 0.01).velocity
    assert velocity[axis] * way > 0.0 if way else velocity == ZERO


@every_controller
def test_a_controller_forgets_everything_when_it_is_reset(module):
    used, fresh = build(module), build(module)
    estimate = Odometry(0, ZERO, UPRIGHT, (1.0, 0.0, 0.0), ZERO)
    for _ in range(50):
        used.update(estimate, Setpoint((3.0, 2.0, 1.0)), 0.01)
    used.reset()
    setpoint = Setpoint((-1.0, 2.0, 0.5))
    assert used.update(estimate, setpoint, 0.01) == fresh.update(estimate, setpoint, 0.01)


scans = st.integers(2, 541).flatmap(
    lambda rays: st.lists(
        st.one_of(st.floats(0.001, 60.0), st.just(inf)), min_size=rays, max_size=rays
    )
)
images = st.builds(
    lambda rows, columns, seed: np.random.default_rng(seed).choice(
        np.array([(230, 26, 20), (0, 0, 0), (255, 255, 255), (90, 120, 60)], np.uint8),
        (rows, columns),
    ),
    *(st.integers(16, 60), st.integers(16, 80), st.integers(0, 99)),
)


def frame(stamp_ns, image):
    """Return an image whose left half has one colour."""
    image[:, : image.shape[1] // 2] = image[0, 0]
    return Frame(stamp_ns, 3, image, 1.0)


@every_perception
@given(ranges=scans, fov=st.floats(0.1, 2 * pi), image=images, sample=odometry)
@fewer
def test_a_setpoint_is_finite_and_equal_things_seen_give_equal_ones(
    module, ranges, fov, image, sample
):
    """Also where nothing is within range, or something on all sides."""
    angles = np.linspace(-fov / 2, fov / 2, len(ranges))
    scan = Scan(sample.stamp_ns, np.array(ranges), angles)
    seen = scan if build(module).takes == "scan" else frame(sample.stamp_ns, image)
    values = seen.ranges if seen is scan else seen.image
    before = values.copy()
    first, again = (build(module).see(seen, sample) for _ in range(2))
    assert (values == before).all(), "others may use it, too"
    assert first == again
    if first is not None:
        assert are_finite(first.position, first.velocity, (first.yaw, first.yaw_rate))


@every_perception
def test_a_perception_forgets_everything_when_it_is_reset(module):
    used, fresh = build(module), build(module)

    def seen(k, sample, far):
        if used.takes == "scan":
            return Scan(sample.stamp_ns, np.linspace(1.0, far, 9), np.linspace(-2.0, 2.0, 9))
        image = np.zeros((60, 80, 3), np.uint8)
        image[20 : 40 - k, 10 + k : 40] = 230, 26, 20
        return frame(sample.stamp_ns, image)

    for k in range(10):
        sample = Odometry(k * 10**8, (0.1 * k, 0.0, 0.0), UPRIGHT, ZERO, ZERO)
        used.see(seen(k, sample, 1.0 + k), sample)
    used.reset()
    for k in range(3):
        sample = Odometry(k * 10**8, ZERO, UPRIGHT, ZERO, ZERO)
        again = seen(k, sample, 5.0 + k)
        assert used.see(again, sample) == fresh.see(again, sample)
