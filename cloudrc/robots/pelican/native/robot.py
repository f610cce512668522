"""A robot that runs its usual steps in C, and all others in Python, with the same results.

In a usual step the robot follows a fresh command that the guard need not limit. Python and `step.c`
share the structure `StepState`: constants, MuJoCo's addresses, present state.
"""

from __future__ import annotations

import ctypes
import logging
from copy import copy
from functools import cache
from math import dist, inf
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.geometry.compiled import mujoco
from cloudrc.geometry.obstacles import fence_of
from cloudrc.geometry.scene import load_scene
from cloudrc.messages import Command, Vector
from cloudrc.robots.pelican import low_level, rotors
from cloudrc.robots.pelican.low_level import LowLevel
from cloudrc.robots.pelican.native.library import Library, library
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard import state
from cloudrc.world.guard.state import Guard
from cloudrc.world.readings import Readings
from cloudrc.world.robot import STEP, STEP_NS, Robot
from cloudrc.world.scene import ROBOT_PREFIX, compile_model, is_of_robot
from cloudrc.world.simulator import CONTACT_CHECK_STEPS, Simulator

_POINTERS = (
    *("mj_step", "model", "free_model", "data", "qpos", "qvel", "ctrl", "applied"),
    *("tip_force", "contacts", "timer", "obstacles"),
)
ACCELERATION_MAX = 400.0
"""Limit of the robot's acceleration in the air [m/s^2]. Full thrust gives a robot that is 10 %
lighter 153 m/s^2, and a spin of 50 rad/s about a centre of mass 3 cm away gives 75 m/s^2."""
MARGIN = 1e-3
"""Distance added to every geom with its own margin and gap [m]; it covers rounding errors."""
HUGE = 1e4
"""Half the edge of the box that stands for the space below a plane [m]."""
PAGE = 4096
"""Smallest size of a page [bytes]: a program may read all bytes of a page, or none."""
SMALLEST = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
"""Model with which the offset of `mjData` is searched."""
MARK = 0x6E636F6E
"""Number that no other part of `mjData` contains."""
UNUSED_WITHOUT_CONTACTS = sum(
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}", 0))  # old versions lack the last two
    for part in ("CONTACT", "CONSTRAINT", "SENSOR", "SPRING", "DAMPER")
)
"""Parts of MuJoCo that do nothing while the robot touches nothing: its usual sensor is a touch
sensor."""
_CONSTANTS = {
    rotors: "thrust_coefficient torque_ratio drag_coefficient arm height",
    low_level: "mass gravity tilt_gain yaw_gain tilt_rate_gain yaw_rate_gain "
    "thrust_max tiny nose_cosine_min yaw_sine_max",
    state: "overturned_cosine",
    rules: "sink_lead_max fence_reaction reaction",
}
"""Modules and their constants that `step.c` needs, in the order of its fields."""
_VALUES = {
    name: getattr(module, name.upper())
    for module, names in _CONSTANTS.items()
    for name in names.split()
}
_double, _int64 = ctypes.c_double, ctypes.c_int64
_FIELDS: dict[str, Any] = {
    **dict.fromkeys(_POINTERS, ctypes.c_void_p),
    **dict.fromkeys([*_VALUES, "stop_coefficient", "up", "down"], _double),
    **{"gains": _double * 9, "limit_xy": _double, "limit_z": _double, "dt": _double},
    **{"change_max": _double, "low": _double * 3, "high": _double * 3},
    **dict.fromkeys(("time_step", "robot_radius", "acceleration_max"), _double),
    **dict.fromkeys(("step_ns", "check_steps", "obstacle_count"), _int64),
    **{"reference": _double * 3, "wanted": _double * 3, "track_until_ns": _int64},
    **{"force_peak": _double, "impulse": _double},
    **dict.fromkeys(("touching", "steps", "is_news", "free_steps"), _int64),
    **{"speeds": _double * 4, "integral": _double * 3, "error": _double * 3},
    **{"has_error": _int64, "before": _double * 13},
}


class StepState(ctypes.Structure):
    """The C structure `StepState`; `step.c` explains its fields."""

    _fields_ = tuple(_FIELDS.items())


def make_state(simulator: Simulator, controller: LowLevel, guard: Guard) -> StepState:
    """Make the C structure `StepState`; fill all fields except the present state of the robot.

    Call `make_state` after a reset of the simulator. Raise an OSError, AttributeError or
    ValueError if this version of MuJoCo lacks a part that `step.c` needs.
    """
    model, data = simulator.model, simulator.data
    turning = rotors.Rotors(simulator.dt)
    limit_xy, limit_z, dt = controller.limits
    arrays = data.qpos, data.qvel, data.ctrl, data.qfrc_applied
    tip_force = data.sensordata[model.sensor(f"{ROBOT_PREFIX}tip").adr[0] :]
    free_model = copy(model)
    free_model.opt.disableflags |= UNUSED_WITHOUT_CONTACTS
    touch = model.sensor_adr[model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH]
    if not {sensor.address for sensor in simulator.sensors} <= {*touch.tolist()}:
        free_model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    obstacles, radius = _obstacles(model, data)
    library = _mujoco_library()
    timer = ctypes.addressof(ctypes.c_void_p.in_dll(library, "mjcb_time"))
    flight = StepState(
        ctypes.cast(library.mj_step, ctypes.c_void_p),
        # MuJoCo has no public name for the addresses.
        *(model._address, free_model._address, data._address),
        *(array.ctypes.data for array in (*arrays, tip_force)),
        *(data._address + _known_offset(), timer, obstacles.ctypes.data),
        *_VALUES.values(),
        *(
            guard.stop_coefficient,
            turning.up,
            turning.down,
            controller.gains,
            limit_xy,
            limit_z,
            dt,
        ),
        guard.acceleration_max * STEP,
        *(guard.fence.inner_low, guard.fence.inner_high),
        *(simulator.dt, radius, ACCELERATION_MAX, STEP_NS),
        *(CONTACT_CHECK_STEPS, len(obstacles)),
    )
    flight.keep = obstacles, free_model  # else Python frees their memory
    return flight


def _obstacles(model: Any, data: Any) -> tuple[Any, float]:
    """Return a box with rounded edges around each geom of the scene, and the robot's radius [m].

    Each row of the array is a box: centre (3,) [m], axes (9,), half sizes (3,) [m], radius of the
    edges [m]. The steps in C search for contacts only while a ball with the robot's radius around
    the base's origin touches a box. If the model has springs or similar forces, the radius is
    infinite, so that C never leaves out the search.
    """
    option, rows, radius, own = model.opt, [], 0.0, is_of_robot(model)
    other = option.density, option.viscosity, model.nflex, model.npair, model.neq, model.ntendon
    each = model.dof_frictionloss, model.dof_damping, model.jnt_stiffness, model.body_gravcomp
    if any(other) or any(values.any() for values in each):
        radius = inf
    for geom in range(model.ngeom):
        size, bound = model.geom_size[geom], model.geom_rbound[geom]
        place, axes = data.geom_xpos[geom], data.geom_xmat[geom]
        margin = model.geom_margin[geom] + model.geom_gap[geom]
        margin = MARGIN + max(margin, option.o_margin)
        if own[geom]:
            radius = max(radius, dist(place, data.qpos[:3]) + bound + margin)
        elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
            rows.append([*place, *axes, *size, margin])
        elif model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
            normal = axes.reshape(3, 3)[:, 2]
            rows.append([*(place - HUGE * normal), *axes, HUGE, HUGE, HUGE, margin])
        else:
            rows.append([*place, *axes, 0.0, 0.0, 0.0, bound + margin])
    return np.array(rows, float), radius


def _mujoco_library() -> ctypes.CDLL:
    """Return MuJoCo's own library, which `import mujoco` has loaded."""
    folder = Path(mujoco.__file__).parent
    files = [*folder.glob("libmujoco.so*"), *folder.glob("libmujoco*.dylib")]
    if len(files) != 1:
        raise OSError(f"{folder}: has {len(files)} files of MuJoCo's library, not 1")
    return ctypes.CDLL(str(files[0]))


@cache
def _known_offset() -> int:
    """Return `_contacts_offset`, which is that of this MuJoCo, and search once only.

    In memory that an earlier `mjData` has used, an old address could end the search too early.
    """
    model = mujoco.MjModel.from_xml_string(SMALLEST)
    return _contacts_offset(mujoco.MjData(model))


def _contacts_offset(data: Any) -> int:
    """Return the offset of the number of contacts in MuJoCo's `mjData` [bytes].

    The offset depends on MuJoCo's version. The function writes MARK to `data.ncon`, searches the
    memory of `data` for it, and restores the number. The address of `qpos` ends the search; it is
    in `mjData`, too, so that the search never leaves the memory of `data`.
    """
    mark, end = Struct("i").pack(MARK), Struct("P").pack(data.qpos.ctypes.data)
    place, block, contacts = data._address, b"", data.ncon
    try:
        data.ncon = MARK
        while mark not in block:
            if end in block:
                raise OSError("mjData does not contain the number of contacts")
            place += len(block)
            block = ctypes.string_at(place, PAGE - place % PAGE)
    finally:
        data.ncon = contacts
    offset: int = place + block.index(mark) - data._address
    return offset


_TRACK = StepState.reference.offset
_MEMORY = StepState.free_steps.offset
_BEFORE = StepState.before.offset
_pack_track, _unpack_track = Struct("6dq2d2q").pack_into, Struct("3d32x2d3q8x4d").unpack_from
_pack_memory, _unpack_memory = Struct("q10dq").pack_into, Struct("40x6d").unpack_from
_unpack_before = Struct("13d").unpack_from


def usable() -> Library:
    """Return the compiled `step.c`; its field `run` is None if it is missing or fails its test.

    `step.c` simulates neither wind nor a true robot that differs from its model.
    """
    found = library()
    return found if found.run is None or not (wrong := _self_test()) else Library(None, wrong)


class NativeRobot(Robot):
    """A `Robot` that simulates usual steps in C (`step.c`) and all others in Python.

    In a usual step the robot follows a fresh command that the guard need not limit. No step runs in
    C while the robot has observers, or while `Simulator.tape` records the controls of each step.
    """

    def __init__(self, simulator: Simulator, low_level: LowLevel, guard: Guard) -> None:
        super().__init__(simulator, low_level, guard)
        self._low_level = low_level
        self._flight = make_state(simulator, low_level, guard)
        self._address = ctypes.addressof(self._flight)
        run = library().run
        assert run is not None
        self._run_steps = run
        self._in_c = False  # whether C has the newest state of the controller

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn with stopped rotors, and record the reason `cause`."""
        self._in_c = False
        super().put_on_ground(now_ns, cause)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run steps from `tick_ns` up to `until_ns`; return the time of the next step [ns].

        C runs the steps while the robot follows a fresh command that the guard need not limit.
        Python runs the first other step, and all steps after it.
        """
        simulator, guard = self.simulator, self.guard
        in_c = not self.observers and simulator.tape is None
        while in_c and (track := guard.plain_track(tick_ns)):
            self._give(*track[1:])
            stop_ns = track[0] if track[0] < until_ns else until_ns
            while steps := self._run_steps(self._address, tick_ns, stop_ns):
                tick_ns += steps * STEP_NS
                self._in_c = True
                # fmt: off
                (
                    x, y, z, peak, impulse, contacts, total, news, front, left, back, right,
                ) = _unpack_track(self._flight, _TRACK)
                # fmt: on
                guard.reference = (x, y, z)
                before = self._before() if news else None
                speeds = (front, left, back, right)
                simulator.take_over(speeds, peak, impulse, contacts, total, before)
                if tick_ns >= stop_ns:
                    break
            if tick_ns >= until_ns:
                return tick_ns
            in_c = tick_ns >= stop_ns  # else C has left a step to Python
        if self._in_c:
            numbers = _unpack_memory(self._flight, _MEMORY)
            self._low_level.integral, self._low_level.error = numbers[:3], numbers[3:]
            self._in_c = False
        return super().run(tick_ns, until_ns)

    def _give(self, reference: Vector, wanted: Vector, track_ns: int) -> None:
        """Copy the robot's state and the arguments to the C structure, before steps in C."""
        simulator = self.simulator
        force = simulator.force_peak, simulator.impulse
        counts = simulator.contacts, simulator.steps
        _pack_track(self._flight, _TRACK, *reference, *wanted, track_ns, *force, *counts)
        if not self._in_c:
            integral, error = self._low_level.integral, self._low_level.error
            memory = (*integral, *(error or integral), error is not None)
            _pack_memory(self._flight, _MEMORY, 0, *simulator.actuators.speeds, *memory)

    def _before(self) -> Readings:
        numbers = _unpack_before(self._flight, _BEFORE)
        return Readings.of(numbers[:7], numbers[7:])


@cache
def _self_test() -> str:
    """Fly in C and in Python; return how the results differ, in words; "" if they are equal."""
    limits = ResolvedGuard()
    model = compile_model(find_robot("pelican").model, file_of("empty"))
    fence = fence_of(load_scene("empty"))
    parts = [
        (Simulator(model, rotors.Rotors(STEP), probe="tip"), LowLevel(), Guard(limits, fence))
        for _ in range(2)
    ]
    wrong = ""
    try:
        if _fly(Robot(*parts[0])) != _fly(NativeRobot(*parts[1])):
            wrong = "C and Python differ"
    except (OSError, AttributeError, ValueError) as error:
        wrong = f"MuJoCo is not as expected: {error!r}"
    if wrong:
        logging.getLogger("cloudrc").warning("all steps run in Python: %s; report this", wrong)
    return wrong


def _fly(robot: Robot) -> list[object]:
    """Fly the self-test: 0.8 s with take-off and curves; return the states on the way."""
    robot.put_on_ground(0, "self-test")
    robot.guard.start_mission(0)
    seen: list[object] = []
    for now_ns in range(0, 800_000_000, 5 * STEP_NS):
        share = now_ns * 1e-9
        velocity = (2.0 * share, 1.0 - share, 3.0 if share < 0.5 else -0.1)
        robot.guard.accept_command(Command(0, now_ns, 0, velocity, 0.0), now_ns)
        robot.run(now_ns, now_ns + 5 * STEP_NS)
        seen += [robot.simulator.readings, robot.guard.reference, robot.simulator.actuators.speeds]
    return seen
