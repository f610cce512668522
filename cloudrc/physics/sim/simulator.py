# SPDX-License-Identifier: Apache-2.0

"""Simulate the physics: turn the commands of the actuators into readings and contacts.

The module writes to MuJoCo's arrays with `struct` and memory views. For four elements, this takes a
quarter of the time of a numpy slice assignment.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from math import dist
from struct import Struct
from typing import Any

import numpy as np
import numpy.typing as npt

from cloudrc.base.outside.values import RESULT
from cloudrc.physics.geometry.scene import FLOOR
from cloudrc.physics.sim.energy import EnergyMeter
from cloudrc.physics.sim.engine import mujoco
from cloudrc.physics.sim.onboard import Actuators, Commands, Inputs
from cloudrc.physics.sim.plant import Wind
from cloudrc.physics.sim.readings import Readings
from cloudrc.physics.sim.scene import OwnSensor, bodies_of_geoms, find_part
from cloudrc.wire.messages import ZERO, Odometry, Quaternion, Vector
from cloudrc.wire.records import Contact, SensorLabel

TOUCH_GAP = 0.1
"""Shortest time without contact before a contact counts as a new contact [s]."""
CONTACT_CHECK_STEPS = 5
"""Number of steps between two checks of the contacts while the number of contacts is constant. A
check takes as long as a step."""
NEVER_TOUCHED = -(1 << 62)
"""Number of the step of a contact that has never been."""

_mj_step = mujoco.mj_step
_BAD = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{part}"))
    for part in ("QPOS", "QVEL", "QACC", "CTRL")
]
"""Numbers of MuJoCo's warnings about values that are not finite."""
_pack_applied = Struct("6d").pack_into
_unpack_pose, _unpack_twist = Struct("7d").unpack_from, Struct("6d").unpack_from
_new = tuple.__new__
_readings_of = Readings.of  # looking up a class method binds it anew each time


def sensor_reader(
    values: memoryview[float], addresses: Sequence[int]
) -> Callable[[], tuple[float, ...]]:
    """Return a function that reads the present `values` at some addresses, in their order."""
    if sorted({*addresses}) != [*addresses]:
        return lambda: tuple(map(values.__getitem__, addresses))
    # The order of MuJoCo, as usual: to unpack all at once takes less time than one by one.
    gaps = (here - before - 1 for before, here in pairwise([-1, *addresses]))
    layout = "".join(f"{values.itemsize * gap}xd" for gap in gaps)
    return partial(Struct(layout).unpack_from, values.cast("B"))


class Simulator:
    """The robot in its scene.

    Attributes:
        model: The compiled `MjModel`.
        data: The `MjData` of the simulation.
        dt: Duration of a step [s].
        steps: Number of steps since the last reset.
        contacts: Number of contacts in the last step.
        sensors: The robot's own sensors, those of its `robot.yaml`.
        force_address: Where MuJoCo writes the force on the probe; None: no sensor measures it.
        force_sensor: Label of the one of `sensors` that shows the force on the probe, if any.
        force_peak: Largest force on the probe since the last call of `take_contact_force` [N].
        impulse: Integral over time of the force on the probe since that call [N s].
        touches: Contacts that began since the last call of `take_contacts`.
        bodies: For each geom, the number of its body; 0 for the robot's.
        touched: Step of the last contact of each body, without the probe and with it, in turn.
        gap_steps: Shortest number of steps without contact before a contact counts as new.
        probe: Number of the probe's site; below 0 without one.
        probe_radius: Radius of the probe [m].
        actuators: Physics of the robot's actuators.
        meter: Energy of the robot's rotors; None if it is not known.
        tape: Inputs of every step since the last reset, for `replay`; None unless a caller sets
            a list.
    """

    def __init__(
        self,
        model: Any,
        actuators: Actuators,
        wind: Wind | None = None,
        probe: str | None = None,
        sensors: Sequence[OwnSensor] = (),
        *,
        judges: bool = False,
    ) -> None:
        """Put the robot of a compiled `MjModel` at its spawn; without `wind` the air is at rest.

        `probe` is the name of the site with which the robot touches; None: any part touches.
        `sensors` are the robot's own sensors. With `judges`, wrong inputs are errors.

        Raises:
            ValueError: If the model has no such site.
        """
        self.model = model
        self._wind = wind
        self.dt: float = model.opt.timestep
        self.tape: list[Inputs] | None = None
        self.data = data = mujoco.MjData(model)
        self.actuators = actuators
        self.meter: EnergyMeter | None = None
        self._inputs: int = model.nu
        self._nothing: Inputs = (0.0,) * (model.nu + 6)
        self._judges = judges
        self._pack_ctrl = Struct(f"{model.nu}d").pack_into

        self._qpos, self._qvel = memoryview(data.qpos), memoryview(data.qvel)
        self._ctrl, self._applied = memoryview(data.ctrl), memoryview(data.qfrc_applied)
        self._sensordata: memoryview[float] = memoryview(data.sensordata)
        self.sensors = tuple(sensors)
        addresses = [each.address for each in sensors]
        self._read_sensors = sensor_reader(self._sensordata, addresses)
        self._find_probe(probe)
        self._note_bodies()
        self.reset()

    def _find_probe(self, probe: str | None) -> None:
        """Find the site with which the robot touches, and its sensor of force."""
        model = self.model
        self.probe = -1 if probe is None else find_part(model, "site", probe, "probe")
        self.force_address = _find_force(model, self.probe)
        of_force = (each for each in self.sensors if each.address == self.force_address)
        self.force_sensor = next((SensorLabel(each.name, each.unit) for each in of_force), None)
        self._probe_offset: Vector = ZERO
        self.probe_radius = -1.0
        if self.probe >= 0:
            self._probe_offset = tuple(model.site_pos[self.probe].tolist())
            self.probe_radius = float(model.site_size[self.probe, 0])

    def _note_bodies(self) -> None:
        """Number the bodies that the robot can touch."""
        names = bodies_of_geoms(self.model)
        self._names = [*dict.fromkeys(["", FLOOR, *names])]
        self.bodies = array("q", map(self._names.index, names))
        self.touched = array("q", [0, 0] * len(self._names))
        self.gap_steps = round(TOUCH_GAP / self.dt)

    def reset(self) -> None:
        """Reset the robot to its spawn, at rest, with still actuators."""
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.steps = self.contacts = 0
        self.force_peak = self.impulse = 0.0
        if self.tape is not None:
            self.tape.clear()
        self.touches: list[Contact] = []
        for number in range(len(self.touched)):
            self.touched[number] = NEVER_TOUCHED
        # The robot stands on the floor: only after a flight is the next contact a new contact.
        self.touched[2 * self._names.index(FLOOR) + (self.probe < 0)] = 0
        self._readings: Readings | None = None
        self.actuators.reset()

    def step(self, commands: Commands | None) -> None:
        """Advance by `dt` with these commands to the actuators; None: they push nothing.

        The physics uses what the actuators do at the end of the step. The actuators get the
        readings at the beginning of the step, with the velocity relative to the air.
        """
        before, data, wind = self.readings, self.data, self._wind
        count, inputs = self._inputs, self._nothing
        if commands is not None:
            in_air = before if wind is None else wind.seen_from(before, self.dt)
            inputs = self.actuators.step(commands, in_air)
        if self._judges:
            inputs = RESULT.row(inputs, count + 6, "input of the actuators")
        self._pack_ctrl(self._ctrl, 0, *inputs[:count])
        _pack_applied(self._applied, 0, *inputs[count:])
        if self.tape is not None:
            self.tape.append(inputs)

        _mj_step(self.model, data)
        self.steps += 1
        self._readings = _readings_of(_unpack_pose(self._qpos), _unpack_twist(self._qvel))
        contacts = data.ncon
        if contacts or self.contacts:
            self._feel(contacts, before)

    def take_over(
        self,
        speeds: Commands,
        force_peak: float,
        impulse: float,
        contacts: int,
        steps: int,
        before: Readings | None,
    ) -> None:
        """Take over the state after steps that other code has run on `data`.

        `speeds` are those of the actuators. `force_peak` [N], `impulse` [N s],
        `contacts` and `steps` are the new values of the attributes. If `before`, the readings
        before the last step, is given, store the contacts of that step.
        """
        self.actuators.speeds, self._readings = speeds, None
        self.force_peak, self.impulse = force_peak, impulse
        self.contacts, self.steps = contacts, steps
        if before:
            self._note_contacts(before)

    @property
    def readings(self) -> Readings:
        """State of the base after the last step."""
        readings = self._readings
        if readings is None:
            readings = _readings_of(_unpack_pose(self._qpos), _unpack_twist(self._qvel))
            self._readings = readings
        return readings

    def truth(self, now_ns: int) -> Odometry:
        """Return the true odometry after the last step, with the stamp `now_ns` [ns]."""
        px, py, pz, w, x, y, z = _unpack_pose(self._qpos)
        vx, vy, vz, p, q, r = _unpack_twist(self._qvel)
        return _new(Odometry, (now_ns, (px, py, pz), (w, x, y, z), (vx, vy, vz), (p, q, r)))

    @property
    def touch_age(self) -> float:
        """Time since the robot's last contact, or since the last reset [s]."""
        return (self.steps - max(self.touched)) * self.dt

    def read_sensors(self) -> tuple[float, ...]:
        """Return what the robot's own sensors show, each in its unit, in the order of `sensors`."""
        return self._read_sensors()

    def bad_values(self) -> int:
        """Return how many positions, velocities, accelerations and controls were not finite.

        MuJoCo replaces them, so the state has none.
        """
        return int(self.data.warning.number[_BAD].sum())

    def take_contact_force(self) -> tuple[float, float, float] | None:
        """Return the normal force on the probe, its peak and its impulse; None without a sensor.

        The force [N] is that at the beginning of the last step. Peak [N] and impulse [N s] are
        those since the last call of this method, which resets both.
        """
        if self.force_address is None:
            return None
        found = self._sensordata[self.force_address], self.force_peak, self.impulse
        self.force_peak = self.impulse = 0.0
        return found

    def take_contacts(self) -> list[Contact]:
        """Return the contacts that began since the last call, oldest first.

        The caller has to set their stamps, which are 0.
        """
        touches, self.touches = self.touches, []
        return touches

    def state(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Return the state from which `replay` can repeat the next steps: physics and warmstart.

        `physics` is the state `mjSTATE_FULLPHYSICS`, shape (n,). `warmstart` has the accelerations
        from which the contact solver of the next step starts, shape (nv,).
        """
        spec = mujoco.mjtState.mjSTATE_FULLPHYSICS
        physics = np.empty(mujoco.mj_stateSize(self.model, spec))
        mujoco.mj_getState(self.model, self.data, physics, spec)
        return physics, self.data.qacc_warmstart.copy()

    def _feel(self, contacts: int, before: Readings) -> None:
        """Update force and impulse on the probe after a step, and store new contacts.

        `contacts` is the number of contacts in the step; `before` has the readings before the step.
        """
        if self.force_address is not None:
            force = self._sensordata[self.force_address]
            self.impulse += force * self.dt
            if force > self.force_peak:
                self.force_peak = force
        # Check at once if the number of contacts has changed, else only every few steps.
        if contacts and (contacts != self.contacts or self.steps % CONTACT_CHECK_STEPS == 0):
            self._note_contacts(before)
        self.contacts = contacts

    def _note_contacts(self, before: Readings) -> None:
        """Store the new contacts, with the robot's motion `before` the step of the simulation."""
        contact, bodies = self.data.contact, self.bodies
        probe = self.data.site_xpos[self.probe].tolist() if self.probe >= 0 else ZERO
        pairs, places = contact.geom.tolist(), contact.pos.tolist()
        for (first, second), place, is_near in zip(
            pairs, places, contact.exclude.tolist(), strict=True
        ):
            if is_near:  # not nearer than the `gap` of a geom
                continue
            body = bodies[first] or bodies[second]
            by_probe = self.probe < 0 or dist(place, probe) <= self.probe_radius
            number = 2 * body + by_probe
            if self.steps - self.touched[number] > self.gap_steps:
                motion = before.position, before.velocity, _velocity_at(before, self._probe_offset)
                self.touches.append(Contact(0, self._names[body], *motion, by_probe))
            self.touched[number] = self.steps


def _find_force(model: Any, site: int) -> int | None:
    """Return where a touch sensor at a site of the model writes; None if there is none."""
    at_site = (model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH) & (model.sensor_objid == site)
    found = np.flatnonzero(at_site)
    return int(model.sensor_adr[found[0]]) if len(found) else None


def _velocity_at(readings: Readings, offset: Vector) -> Vector:
    """Return the velocity of a point fixed to the base at `offset` [m], in [m/s], world frame."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = readings.axes
    p, q, r = readings.angular_velocity_body
    x, y, z = offset
    u, v, w = q * z - r * y, r * x - p * z, p * y - q * x
    vx, vy, vz = readings.velocity
    return (
        vx + xx * u + yx * v + zx * w,
        vy + xy * u + yy * v + zy * w,
        vz + xz * u + yz * v + zz * w,
    )


def rest_height(model: Any, commands: Commands, duration: float) -> float:
    """Return the height of the base after a time under these commands [m], world frame.

    `model` is a compiled `MjModel`, `duration` the time [s].
    """
    data = mujoco.MjData(model)
    data.ctrl[:] = commands
    mujoco.mj_step(model, data, round(duration / model.opt.timestep))
    return float(data.qpos[2])


def turned(orientation_wxyz: Quaternion, turn: Vector) -> Quaternion:
    """Turn an orientation by the rotation vector `turn` [rad], body frame, shape (3,).

    `orientation_wxyz` is a unit quaternion, body to world.
    """
    quaternion = np.array(orientation_wxyz)
    mujoco.mju_quatIntegrate(quaternion, np.array(turn), 1.0)
    w, x, y, z = quaternion.tolist()
    return (w, x, y, z)


def replay(
    model: Any, physics: npt.ArrayLike, warmstart: npt.ArrayLike, tape: npt.ArrayLike
) -> npt.NDArray[np.float64]:
    """Repeat the steps recorded in a `Simulator.tape` with MuJoCo alone, to measure its speed.

    `physics` and `warmstart` are the result of `Simulator.state()` before the first step. Return
    the state of the physics after the last step; it equals the simulator's state bit by bit.
    """
    from mujoco import rollout

    state = mujoco.mjtState
    states, _ = rollout.rollout(
        model,
        mujoco.MjData(model),
        physics,
        np.asarray(tape),
        control_spec=state.mjSTATE_CTRL | state.mjSTATE_QFRC_APPLIED,
        initial_warmstart=warmstart,
    )
    end: npt.NDArray[np.float64] = states[0, -1]
    return end
