"""The true robot differs from its model as the keys say, and the wind has its statistics."""

import numpy as np
import pytest

from cloudrc.config.schema import Plant
from cloudrc.messages import UPRIGHT, ZERO
from cloudrc.world.plant import Wind, apply_plant
from cloudrc.world.readings import Readings
from cloudrc.world.scene import compile_model, mujoco

SPHERE = 0.5, (0.1, -0.2, -0.3)
"""Mass [kg] and place [m] of a body that MuJoCo itself adds to a robot."""


def model(**keys):
    made = compile_model("pelican", "empty")
    apply_plant(Plant(**keys), made)
    return made


def inertia(one):
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, one.body_iquat[1])
    axes = turn.reshape(3, 3)
    assert np.linalg.det(axes) == pytest.approx(1.0)
    return axes @ np.diag(one.body_inertia[1]) @ axes.T


def test_factors_scale_mass_and_inertia_apart():
    as_it_is, heavy = model(), model(mass_factor=1.2, inertia_factor=1.5)
    assert heavy.body_mass[1] == pytest.approx(1.2 * 1.06)
    assert inertia(heavy) == pytest.approx(1.5 * inertia(as_it_is))
    assert heavy.body_subtreemass[0] == pytest.approx(1.2 * 1.06), "constants are computed anew"
    assert np.array_equal(as_it_is.body_iquat, compile_model("pelican", "empty").body_iquat)


def test_a_payload_is_what_mujoco_makes_of_a_second_body():
    mass, place = SPHERE
    text = (
        "<mujoco><worldbody><body><freejoint/>"
        '<inertial pos=".004 0 .005" mass="1.06" fullinertia=".012 .011 .020 0 -.0003 0"/>'
        '<geom size=".01" mass="0"/>{}</body></worldbody></mujoco>'
    )
    point = '<inertial pos="0 0 0" mass="{}" diaginertia="1e-9 1e-9 1e-9"/>'
    body = f'<body pos="{{}} {{}} {{}}">{point}</body>'
    both = mujoco.MjSpec.from_string(text.format(body.format(*place, mass)))
    both.compiler.fusestatic = True
    wanted = both.compile()
    found = mujoco.MjModel.from_xml_string(text.format(""))
    without_rotors = Plant(payload_kg=mass, payload_offset_m=place)
    apply_plant(without_rotors.model_copy(update={"thrust_factor": ()}), found)
    assert wanted.nbody == found.nbody == 2
    assert found.body_mass[1] == pytest.approx(wanted.body_mass[1])
    assert found.body_ipos[1] == pytest.approx(wanted.body_ipos[1])
    assert inertia(found) == pytest.approx(inertia(wanted), abs=1e-8)


def test_a_weak_rotor_has_less_thrust_and_less_torque():
    weak = model(thrust_factor=(1.0, 0.7, 1.0, 1.0))
    data = mujoco.MjData(weak)
    data.ctrl[:] = 3.0
    mujoco.mj_forward(weak, data)
    assert data.actuator_force == pytest.approx([3.0, 2.1, 3.0, 3.0])
    assert data.qfrc_actuator[5] == pytest.approx(0.016 * (3.0 - 2.1 + 3.0 - 3.0))


def test_gusts_have_their_deviation_and_their_time_constant():
    wind = Wind((3.0, -1.0), 0.8, 0.2, np.random.default_rng(5))
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
