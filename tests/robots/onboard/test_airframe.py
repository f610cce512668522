# SPDX-License-Identifier: Apache-2.0

"""What the controller reads from a model, and which models it refuses."""

import numpy as np
import pytest

from cloudrc.physics.sim.airframe import read_airframe
from cloudrc.robots.onboard import multirotor
from tests.robots.onboard.conftest import X, big, compiled, nano, robot, x_layout

INERTIA = ".03 .025 .05"
ROTORS = x_layout(0.14, 0.17, 0.02, 8.0)


def changed(old, new, text=None):
    found = (text or big()).replace(old, new)
    assert found != (text or big())
    return found


def with_spins(*spins):
    corners = [(x, y, spin) for (x, y, _), spin in zip(X, spins, strict=True)]
    return robot(x_layout(0.14, 0.17, 0.02, 8.0, corners), 1.3, INERTIA)


def test_mass_centre_and_inertia_count_every_body():
    # 1.3 kg at 0 and .2 kg at .3 m: centre at .04 m, reduced mass .1733 kg, .0156 kg m^2 more.
    more = (
        '<body pos="0 0 .3"><inertial pos="0 0 0" mass=".2" diaginertia="1e-3 1e-3 1e-3"/></body>'
    )
    for euler in ("0 0 0", "20 30 40"):
        text = changed('pos="0 0 2"', f'pos="0 0 2" euler="{euler}"', big(base=more))
        frame = read_airframe(compiled(text))
        assert frame.mass == pytest.approx(1.5)
        assert frame.centre == pytest.approx((0.0, 0.0, 0.04))
        assert frame.inertia == pytest.approx(np.diag((0.0466, 0.0416, 0.051)))
        assert frame.gravity == pytest.approx(9.81)
        assert frame.wrench[3] == pytest.approx((0.02, -0.02, 0.02, -0.02))


def test_torques_are_about_the_centre_of_mass():
    frame = read_airframe(compiled(big(centre=".03 -.02 .04")))
    assert frame.wrench[0] == pytest.approx((-0.15, 0.19, 0.19, -0.15))  # y of the rotors
    assert frame.wrench[1] == pytest.approx((-0.11, -0.11, 0.17, 0.17))  # -x of the rotors
    assert frame.wrench[2] == pytest.approx((1.0, 1.0, 1.0, 1.0))


def test_the_force_range_and_the_gain_limit_a_control():
    more = 'gainprm="2" forcelimited="true" forcerange="1 9"'
    frame = read_airframe(compiled(robot(x_layout(0.14, 0.17, 0.02, 8.0, more=more), 1.3, INERTIA)))
    assert (frame.low[0], frame.high[0]) == (0.5, 4.5)
    assert frame.wrench[2, 0] == pytest.approx(2.0)


REFUSED = {
    "mass in g": (robot(ROTORS, 1300, INERTIA), "hover needs 39853 % of the thrust; above 77 %"),
    "one direction": (with_spins(1, 1, 1, 1), r"torque about z \(yaw\).*spin direction"),
    "one of four": (with_spins(1, -1, 1, 1), "from actuator r0, which has no room"),
    "servo": (changed("<general", '<general biastype="affine"'), "r0 must push at a site"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_model_that_it_cannot_fly_is_refused_in_one_line(name):
    text, message = REFUSED[name]
    with pytest.raises(ValueError, match=message) as error:
        multirotor.build(compiled(text))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "parameter",
    [
        {"velocity_bandwidth_radps": 11.0},
        {"attitude_bandwidth_radps": 101.0},
    ],
)
def test_a_value_that_does_not_fit_is_refused_by_its_name(parameter):
    (name,) = parameter
    with pytest.raises(ValueError, match=name):
        multirotor.build(compiled(nano()), **parameter)
