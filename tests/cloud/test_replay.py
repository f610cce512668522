# SPDX-License-Identifier: Apache-2.0

"""Predictors that replay commands: the times of the commands, and numbers worked by hand."""

from itertools import pairwise
from math import exp

import numpy as np
import pytest

from cloudrc.cloud.predictors import command_history, kalman, model_based
from cloudrc.cloud.predictors._history import Replay
from cloudrc.wire.messages import UPRIGHT, ZERO, Command, Odometry
from tests.cloud.conftest import MS, planned
from tests.support.robots import facts_of

PELICAN = facts_of("pelican", 12.0)
AHEAD = 1234 * MS  # cloud's clock minus world's clock [ns]


def command(sent_ms, x):
    """Return a command along x that leaves at `sent_ms`, world's clock."""
    return Command(sent_ms * MS + AHEAD, 0, 0, (x, 0.0, 0.0), 0.0)


def sample(at_ms, x=0.0, v=0.0):
    return Odometry(at_ms * MS, (x, 0.0, 0.0), UPRIGHT, (v, 0.0, 0.0), ZERO)


def in_ms(parts):
    return [(velocity[0], round(duration * 1e3)) for velocity, duration in parts]


# When the robot follows which command


ECHOES = {1: 60, 3: 75, 4: 95}
"""Command -> when the robot began to follow it [ms]."""


@pytest.mark.parametrize(
    ("echoes", "start_ms", "end_ms", "parts"),
    [
        (ECHOES, 60, 100, [(1, 15), (3, 20), (4, 5)]),
        (ECHOES, 70, 80, [(1, 5), (3, 5)]),
        (ECHOES, 50, 65, [(1, 5)]),
        # With tunnel.order: arrival, the robot may follow an older command after a newer one.
        ({0: 50, 2: 60, 1: 70}, 50, 80, [(0, 10), (2, 10), (1, 10)]),
    ],
)
def test_the_echoes_show_the_past(echoes, start_ms, end_ms, parts):
    history = Replay()
    for k in range(10):
        history.commanded(command(10 * k, float(k)))
    for k, at_ms in echoes.items():
        history.applied(command(10 * k, 0).stamp_ns, at_ms * MS)
    assert in_ms(history.past(start_ms * MS, end_ms * MS)) == parts


@pytest.mark.parametrize(
    ("every", "period_ms", "odometry_ms", "expected"),
    [(1, 10, 10, 50), (2, 10, 10, 55), (1, 20, 10, 50), (1, 2, 10, 50), (1, 10, 50, 50)],
)
def test_the_shift_gives_commands_their_mean_age(every, period_ms, odometry_ms, expected):
    """Commands take 50 ms, and each `every`-th arrives: without its successor it acts longer."""
    history = Replay()
    for k in range(400):
        history.commanded(command(period_ms * k, 0.0))
        begins_ms = period_ms * k + 50
        history.observe(sample((begins_ms - 1) // odometry_ms * odometry_ms))
        if k % every == 0 and begins_ms % odometry_ms < period_ms:
            history.applied(command(period_ms * k, 0).stamp_ns, begins_ms * MS)
    shift_ms = (history.shift_ns(sample(0), 0.1) + AHEAD) / MS
    assert shift_ms == pytest.approx(expected, abs=1.5)


def test_a_history_forgets_the_oldest_commands():
    predictor = command_history.build(robot=PELICAN)
    for k in range(5000):
        predictor.commanded(command(10 * k, 1.0))
    assert len(predictor.stamps) < 4096
    predictor.applied(command(49_940, 0).stamp_ns, 49_990 * MS)
    at_speed = predictor.predict(sample(49_990, v=1.0), 0.05)
    assert at_speed.position[0] == pytest.approx(0.05, abs=1e-6)
    forgotten = predictor.predict(sample(1000, v=1.0), 0.05)
    assert forgotten.position[0] == pytest.approx(0.0, abs=0.1)


def after_silence(predictor, *, lost):
    """Return the error of a prediction by 0.3 s, after a silence of 20 s in which a robot held.

    Telemetry, commands or nothing is `lost`. The robot follows its commands 50 ms late.
    """
    truth, dark, x = at_rest(), range(200, 200 if lost == "none" else 2200), {}
    for k in range(2260):
        state = truth.odometry()
        x[k] = state.position[0]
        if k not in dark or lost == "commands":
            if k not in dark and k >= 5:
                predictor.applied(command(10 * k - 50, 0).stamp_ns, 10 * k * MS)
            newest = state._replace(stamp_ns=10 * k * MS)
            predictor.observe(newest)
        if k == 2220:
            later = predictor.predict(newest, 0.3).position[0]
        predictor.commanded(command(10 * k, wanted(k)))
        truth.step((wanted(k - 5) if k - 5 not in dark and k not in dark else 0.0, 0, 0), 0.01)
    return later - x[2250]


def at_rest(**parameters):
    """Return the white box at rest."""
    predictor = model_based.build(robot=PELICAN, **parameters)
    predictor.predict(sample(0), 0.0)
    return predictor.model()


def wanted(k):
    return 2.0 if 0 <= k < 200 else -2.0 if k >= 2200 else 0.0


@pytest.mark.parametrize("lost", ["telemetry", "commands"])
@pytest.mark.parametrize("module", [command_history, model_based, kalman])
def test_a_silence_of_20_s_leaves_no_error(module, lost):
    without = after_silence(module.build(robot=PELICAN), lost="none")
    assert after_silence(module.build(robot=PELICAN), lost=lost) == pytest.approx(without, abs=0.01)


# Plans


def test_command_history_knows_the_plan_between_two_commands():
    """At 20 Hz the robot flies four steps of the plan before the next command."""
    planning, plain = command_history.build(robot=PELICAN), command_history.build(robot=PELICAN)
    for k in range(20):
        planning.commanded(planned(50 * k, 0.0, *[1.0] * (4 * (k > 9))))
        plain.commanded(planned(50 * k, 0.0))
    assert plain.predict(sample(850), 0.1).position[0] == 0.0
    assert planning.predict(sample(850), 0.1).velocity[0] > 0.1


# command_history


def after_a_step(horizon, **parameters):
    """Return a prediction at rest, 50 ms before a step to 1 m/s begins; commands take 50 ms."""
    predictor = command_history.build(robot=PELICAN, **{"acceleration_max": 1e9, **parameters})
    for k in range(60):
        predictor.commanded(command(10 * k, float(k >= 50)))
        predictor.applied(command(10 * k, 0).stamp_ns, (10 * k + 50) * MS)
    return predictor.predict(sample(500, x=2.0), horizon)


def test_a_step_is_a_first_order_response_after_its_delay():
    predicted = after_a_step(0.25, dead_time=(0, 0, 0), time_constant=(0.2, 0.2, 0.2))
    # 200 ms of the step act; the middle of a 10 ms step is where its command begins.
    assert predicted.velocity[0] == pytest.approx(1.0 - exp(-1.0), abs=0.02)
    assert predicted.position[0] == pytest.approx(2.0 + 0.2 - 0.2 * (1.0 - exp(-1.0)), abs=0.004)
    assert predicted.velocity[1:] == predicted.position[1:] == (0.0, 0.0)


def test_dead_time_gain_and_acceleration_limit_act():
    plain = after_a_step(0.25).velocity[0]
    assert after_a_step(0.25, dead_time=(0.2, 0.2, 0.2)).velocity[0] < 0.7 * plain
    assert after_a_step(0.25, gain=(0.5, 1, 1)).velocity[0] == pytest.approx(0.5 * plain)
    assert after_a_step(0.25, acceleration_max=2.0).velocity[0] < 0.5 * plain


def test_a_measured_velocity_that_no_command_explains_decays():
    predictor = command_history.build(robot=PELICAN, time_constant=(0.5, 0.5, 0.5))
    predictor.commanded(command(0, 0.0))
    predictor.applied(command(0, 0).stamp_ns, 50 * MS)
    predicted = predictor.predict(sample(100, v=1.0), 0.5)
    assert predicted.velocity[0] == pytest.approx(exp(-1.0))
    assert predicted.position[0] == pytest.approx(0.5 * (1.0 - exp(-1.0)))


def test_values_of_a_file_replace_the_parameters(tmp_path):
    path = tmp_path / "model.yaml"
    path.write_text("time_constant: [.5, .5, .5]\ndead_time: [0, 0, 0]\ngain: [1, 1, 1]\nmore: 1\n")
    own = after_a_step(0.2, time_constant=(0.5, 0.5, 0.5), dead_time=(0, 0, 0))
    assert after_a_step(0.2, model=path) == own


# model_based and kalman


def fly(predictor, push=0.0, noise=0.0, seconds=6.0):
    """Command a model to stand still; `push` [m/s^2] acts on it, `noise` is measured [m, m/s].

    Return the errors of the predictions by 100 ms, as (position [m], velocity [m/s]) along x.
    """
    rng, truth, states, predicted = np.random.default_rng(1), at_rest(), [], []
    for k in range(round(seconds * 100)):
        predictor.commanded(still := command(10 * k - 50, 0.0))
        predictor.applied(still.stamp_ns, 10 * k * MS)
        state = truth.odometry() if k else sample(0)
        x, v = state.position[0], state.velocity[0]
        states.append((x, v))
        truth.velocity = (v + push * 0.01, *truth.velocity[1:])
        truth.step(ZERO, 0.01)
        measured = sample(10 * k, x + noise * rng.normal(), v + 4 * noise * rng.normal())
        predictor.observe(measured)
        later = predictor.predict(measured, 0.1)
        predicted.append((later.position[0], later.velocity[0]))
    return np.array(predicted[:-10]) - np.array(states[10:])


def rms(errors):
    return float(np.sqrt((errors**2).mean()))


def test_a_sinking_reference_leads_by_half_a_metre_per_second():
    sinking = at_rest()
    states = [sinking.step((0.0, 0.0, -3.0), 0.01) for _ in range(20)]
    falls = [(b.velocity[2] - a.velocity[2]) / 0.01 for a, b in pairwise(states)]
    assert min(falls) > -9.0  # without the limit the rotors would stop


def test_model_based_learns_a_constant_push():
    errors = fly(model_based.build(robot=PELICAN), push=0.5, seconds=12.0)
    assert rms(errors[-100:, 1]) < 0.3 * rms(errors[5:50, 1])


@pytest.mark.parametrize("model", ["white_box", "first_order"])
def test_kalman_halves_the_noise_of_the_odometry(model):
    noisy = {"white_box": model_based, "first_order": command_history}[model].build(robot=PELICAN)
    quiet = kalman.build(robot=PELICAN, model=model)
    raw, filtered = (fly(each, noise=0.005)[100:] for each in (noisy, quiet))
    assert rms(filtered[:, 0]) < 0.5 * rms(raw[:, 0])
    assert rms(filtered[:, 1]) < 0.5 * rms(raw[:, 1])
