# SPDX-License-Identifier: Apache-2.0

"""Multirotors made of MJCF text, and a flight that runs one controller in MuJoCo, without world."""

from math import acos, cos, degrees, hypot, pi, sin

import numpy as np

from cloudrc.physics.sim.engine import mujoco
from cloudrc.physics.sim.readings import Readings
from cloudrc.robots.onboard import multirotor

DT = 0.002
X = ((1, -1, 1), (1, 1, -1), (-1, 1, 1), (-1, -1, -1))
"""Places of the rotors of an X layout, relative to its arms, and their spin directions."""


def rotor(number, x, y, spin, *, high, z=0.0, more=""):
    """Return site and actuator of a rotor; `spin` is its torque per thrust [m]."""
    site = f'<site name="r{number}" pos="{x} {y} {z}"/>'
    actuator = f'<general name="r{number}" site="r{number}" gear="0 0 1 0 0 {spin}"'
    return site, f'{actuator} ctrllimited="true" ctrlrange="0 {high}" {more}/>'


def robot(rotors, mass, inertia, *, base="", centre="0 0 0", joint="<freejoint/>", option=""):
    """Return the MJCF text of a robot; `base` are further elements of its base body."""
    sites, actuators = zip(*rotors, strict=True) if rotors else ((), ())
    return f"""<mujoco>
      <option timestep="{DT}" {option}/>
      <worldbody><body name="base" pos="0 0 2">{joint}
        <inertial pos="{centre}" mass="{mass}" diaginertia="{inertia}"/>
        <geom type="sphere" size=".01" mass="0"/>{"".join(sites)}{base}
      </body></worldbody>
      <actuator>{"".join(actuators)}</actuator>
    </mujoco>"""


def x_layout(arm_x, arm_y, spin, high, corners=X, **more):
    return [
        rotor(number, arm_x * x, arm_y * y, spin * turn, high=high, **more)
        for number, (x, y, turn) in enumerate(corners)
    ]


def big(**more):
    """A robot of 1.3 kg: rotors of at most 8 N, T/W of 2.5."""
    return robot(x_layout(0.14, 0.17, 0.02, 8.0), 1.3, ".03 .025 .05", **more)


SKEW = big().replace('diaginertia=".03 .025 .05"', 'fullinertia=".03 .025 .05 .006 .005 -.004"')
"""It has products of inertia."""


def nano(**more):
    """A robot of 27 g whose four rotors lift 60 g.

    Source of the sizes: J. Förster, "System Identification of the Crazyflie 2.0 Nano Quadrocopter",
    ETH Zürich, 2015: mass, inertia, arm and torque per thrust.
    """
    return robot(x_layout(0.0325, 0.0325, 0.006, 0.15), 0.027, "1.66e-5 1.67e-5 2.93e-5", **more)


def hexarotor(**more):
    rotors = [
        rotor(number, 0.3 * cos(angle), 0.3 * sin(angle), 0.02 * (-1) ** number, high=10.0)
        for number in range(6)
        for angle in [pi / 6 + number * pi / 3]
    ]
    return robot(rotors, 2.4, ".06 .06 .11", **more)


def one_site(**more):
    """A robot whose actuators are a thrust and three torques at one site."""
    gears = {"0 0 1 0 0 0": "0 20", "0 0 0 1 0 0": "-1 1", "0 0 0 0 -1 0": "-1 1"}
    gears["0 0 0 0 0 1"] = "-.2 .2"
    actuators = [
        ("", f'<motor site="s" gear="{gear}" ctrllimited="true" ctrlrange="{limits}"/>')
        for gear, limits in gears.items()
    ]
    return robot(actuators, 1.0, ".01 .01 .02", base='<site name="s"/>', **more)


def compiled(text):
    return mujoco.MjModel.from_xml_string(text)


class Flight:
    """A plant with its controller, which may have been built for another model."""

    def __init__(self, text, known=None, *, drag=0.0, **parameters):
        self.model = compiled(text)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        known = self.model if known is None else compiled(known)
        self.onboard = multirotor.build(known, **parameters)
        self.actuators = multirotor.actuators(known, DT, drag_s_per_m=drag)
        self._upright = 1.0

    @property
    def readings(self):
        return Readings.of(self.data.qpos.tolist(), self.data.qvel.tolist())

    def fly(self, seconds, velocity=(0.0, 0.0, 0.0), yaw_rate=0.0, *, brake=False):
        """Fly; return the velocities, shape (n, 3)."""
        velocities = []
        for _ in range(round(seconds / DT)):
            readings = self.readings
            if brake:
                commands = self.onboard.brake(readings, velocity)
            else:
                commands = self.onboard.update(readings, velocity, yaw_rate)
            inputs = self.actuators.step(commands, readings)
            self.data.ctrl[:] = inputs[: self.model.nu]
            self.data.qfrc_applied[:] = inputs[self.model.nu :]
            mujoco.mj_step(self.model, self.data)
            velocities.append(self.data.qvel[:3].copy())
            self._upright = min(self._upright, readings.axes[8])
        return np.array(velocities)

    @property
    def tilt(self):
        """Largest tilt so far [deg]."""
        return degrees(acos(self._upright))

    @property
    def yaw(self):
        axes = self.readings.axes
        return np.arctan2(axes[1], axes[0])

    @property
    def speed(self):
        return hypot(*self.data.qvel[:3])
