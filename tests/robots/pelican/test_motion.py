# SPDX-License-Identifier: Apache-2.0

"""Predictions and plans in C and in Python have the same bits."""

from itertools import chain

import numpy as np
import pytest

from cloudrc.cloud.controllers.pid import build as pid
from cloudrc.cloud.motion import Body, pack_goal
from cloudrc.robots.native.library import Library, library
from cloudrc.robots.pelican import motion
from cloudrc.wire.messages import UPRIGHT, ZERO, Odometry, Setpoint
from cloudrc.wire.tunnel.codec import as_planned

pytestmark = pytest.mark.skipif(library().run is None, reason=library().text)
STATE = "position", "velocity", "_axis", "_rate", "_torque", "_thrust", "_reference", "_integral"


def both(monkeypatch, rng, height):
    """Start the model in Python and in C, in one state, with disturbances that it has learned."""
    models = []
    vectors = [tuple(rng.normal(0.0, scale, 3).tolist()) for scale in (1.0, 1.0, 0.1)]
    x, y, z = vectors[0]
    basis = Odometry(0, (x, y, height + abs(z)), UPRIGHT, *vectors[1:])
    for native in (Library(None, "test"), library()):
        monkeypatch.setattr(motion, "library", lambda native=native: native)
        model = motion.build(acceleration_max=3.0)(basis)
        model.correct(basis._replace(stamp_ns=10_000_000, velocity=vectors[0]))
        models.append(model)
    return models


def state(model):
    return [getattr(model, name) for name in STATE]


@pytest.mark.parametrize("height", [0.2, 3.0])  # the guard limits near the floor
@pytest.mark.parametrize("seed", range(4))
def test_commands_move_the_model_the_same_in_c(seed, height, monkeypatch):
    rng = np.random.default_rng(seed)
    python, c = both(monkeypatch, rng, height)
    for scale in (0.5, 3.0, 30.0):
        commands = [
            (tuple(rng.normal(0.0, scale, 3).tolist()), float(rng.uniform(1e-4, 0.035)))
            for _ in range(40)
        ]
        for model in (python, c):
            model.replay(commands)
        assert state(python) == state(c)
        assert python.coast((scale, 0.0, -scale), 0.02, 39) == c.coast(
            (scale, 0.0, -scale), 0.02, 39
        )
        assert python.odometry() == c.odometry()


@pytest.mark.parametrize("gain_d", [ZERO, (0.5, 0.5, 0.0)])
def test_a_plan_is_the_same_in_c(gain_d, monkeypatch):
    rng = np.random.default_rng(1)
    python, c = both(monkeypatch, rng, 0.3)
    before = state(c)
    controller = pid(gain_p=(2.5, 2.5, 3.0), gain_d=gain_d)
    moving = [ZERO, *(tuple(each) for each in rng.normal(0.0, 1.0, (39, 3)).tolist())]
    goals = [Setpoint(tuple(rng.normal(0.0, 2.0, 3).tolist()), velocity=each) for each in moving]
    velocity, expected, positions = (0.1, -0.2, 0.3), [], []
    for goal in goals:
        at = python.step(velocity, 0.01)
        velocity = controller.update(at, goal, 0.01).velocity
        expected.append(velocity)
        positions.append(at.position)
    rows = [*map(pack_goal, goals)]
    found = c.follow(controller.law, rows, 0.01, (0.1, -0.2, 0.3), 1000.0)
    assert found == (as_planned([*chain.from_iterable(expected)]), positions)
    assert state(c) == before
    least = max(map(abs, expected[20]))
    assert c.follow(controller.law, rows, 0.01, (0.1, -0.2, 0.3), 0.9 * least) is None


def test_only_a_controller_without_memory_and_limits_has_a_law():
    assert [
        pid(**given).law is None for given in ({}, {"gain_i": (1, 0, 0)}, {"speed_max": 1})
    ] == [
        False,
        True,
        True,
    ]
    assert Body.follow(None, pid().law, [], 0.01, ZERO, 1.0) is None
