# SPDX-License-Identifier: Apache-2.0

"""The true robot differs from its model as the keys say, and the wind has its statistics."""

import numpy as np
import pytest

from cloudrc.config import schema
from cloudrc.config.disturbances import Plant
from cloudrc.config.robot import find_robot
from cloudrc.physics.sim.engine import mujoco
from cloudrc.physics.sim.plant import Wind, point_inertia
from cloudrc.physics.sim.readings import Readings
from cloudrc.wire.messages import UPRIGHT, ZERO
from tests.world.conftest import model_of


def model(**keys):
    return model_of(plant=Plant(**keys))


def inertia(one):
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, one.body_iquat[1])
    axes = axes.reshape(3, 3)
    return one.body_mass[1], one.body_ipos[1], axes @ np.diag(one.body_inertia[1]) @ axes.T


def test_factors_scale_mass_and_inertia_apart():
    _, centre, moments = inertia(model())
    heavy = model(mass_factor=1.2, inertia_factor=1.5)
    assert heavy.body_mass[1] == heavy.body_subtreemass[0] == pytest.approx(1.2 * 1.06)
    assert inertia(heavy)[1] == pytest.approx(centre)
    assert inertia(heavy)[2] == pytest.approx(1.5 * moments)


def test_a_payload_is_what_mujoco_makes_of_a_second_body():
    mass, place = 0.5, (0.1, -0.2, -0.3)
    spec = mujoco.MjSpec.from_file(str(find_robot("pelican").model))
    point = {"mass": mass, "inertia": [1e-9] * 3, "ipos": [0.0] * 3, "explicitinertial": True}
    spec.body("base").add_body(name="payload", pos=place, **point)
    data = mujoco.MjData(whole := spec.compile())
    mujoco.mj_forward(whole, data)
    total, centre, moments = inertia(model(payload_kg=mass, payload_offset_m=place))
    assert total == pytest.approx(whole.body_subtreemass[1]) == pytest.approx(1.56)
    assert centre == pytest.approx(data.subtree_com[1])
    places = data.xipos[1:] - centre
    parts = [
        turn.reshape(3, 3) @ np.diag(own) @ turn.reshape(3, 3).T + point_inertia(m, place)
        for turn, own, m, place in zip(
            data.ximat[1:], whole.body_inertia[1:], whole.body_mass[1:], places, strict=True
        )
    ]
    assert moments == pytest.approx(sum(parts), abs=1e-8)


def test_a_weak_rotor_has_less_thrust_and_less_torque():
    weak = model(actuator_factor=(1.0, 0.7, 1.0, 1.0))
    data = mujoco.MjData(weak)
    data.ctrl[:] = 3.0
    mujoco.mj_forward(weak, data)
    assert data.actuator_force == pytest.approx([3.0, 2.1, 3.0, 3.0])
    assert data.qfrc_actuator[5] == pytest.approx(0.016 * (3.0 - 2.1 + 3.0 - 3.0))


def test_gusts_have_their_deviation_and_their_time_constant():
    section = schema.WindConfig(velocity_mps=(3.0, -1.0), gust_mps=0.8, gust_time_s=0.2)
    wind = Wind(section, np.random.default_rng(5))
    still = Readings.of((*ZERO, *UPRIGHT), (*ZERO, *ZERO))
    air = -np.array([wind.seen_from(still, 0.02).velocity for _ in range(40_000)])
    assert not air[:, 2].any()
    gusts = air[:, :2] - (3.0, -1.0)
    assert gusts.mean(axis=0) == pytest.approx((0.0, 0.0), abs=0.06)
    assert gusts.std(axis=0) == pytest.approx((0.8, 0.8), rel=0.05)
    # One time constant is ten samples of 0.02 s.
    after = (gusts[:-10] * gusts[10:]).mean(axis=0) / gusts.var(axis=0)
    assert after == pytest.approx((np.exp(-1), np.exp(-1)), abs=0.05)
    assert np.corrcoef(gusts.T)[0, 1] == pytest.approx(0.0, abs=0.05)
