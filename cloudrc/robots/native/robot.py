# SPDX-License-Identifier: Apache-2.0

"""A robot that runs its usual steps in C, and all others in Python, with the same results.

In a usual step the robot follows a fresh command that the guard need not limit, or stands on the
ground, switched off. Python and `step.c` share the structure `StepState`: constants, MuJoCo's
addresses, present state. The onboard controller has a structure of its own, which its `Twin` makes.
"""

from __future__ import annotations

import ctypes
import logging
import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cache, partial
from struct import Struct
from typing import Any, ClassVar, TypeAlias

import numpy as np

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.geometry.fence import FLOOR_MARGIN
from cloudrc.physics.sim.memory import (
    boxes_around,
    contacts_offset,
    mujoco_library,
    without_contacts,
)
from cloudrc.physics.sim.onboard import Accelerator, Actuators, Onboard
from cloudrc.physics.sim.readings import Readings
from cloudrc.physics.sim.simulator import CONTACT_CHECK_STEPS, Simulator
from cloudrc.robots.native.library import Library, library
from cloudrc.wire.messages import NEVER_NS, ZERO, Command, GuardState, Vector
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard import state
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import STEP, STEP_NS, Robot

GROUND = GuardState.GROUND  # looking up a member of an enum is slow
ACTUATORS_MAX = 16
"""Largest number of actuators that the structures of C hold."""
_POINTERS = (
    *("mj_step", "model", "free_model", "data", "qpos", "qvel", "ctrl", "applied"),
    *("probe_force", "contacts", "contact_geoms", "contact_place", "contact_excluded"),
    *("bodies", "touched", "probe", "timer", "obstacles", "control", "controller"),
)
_function = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double, ctypes.c_double)
_HYPOT = _function(math.hypot)
Build: TypeAlias = Callable[[Any], tuple[Onboard, Actuators]]
"""Makes onboard controller and actuators for a compiled `MjModel`."""
_double, _int64 = ctypes.c_double, ctypes.c_int64
_VALUES = (
    *("overturned_cosine", "sink_lead_max", "fence_reaction", "reaction"),
    *("far", "return_gain", "return_speed_max", "low_speed", "stop_coefficient"),
)
_FIELDS: dict[str, Any] = {
    **dict.fromkeys(_POINTERS, ctypes.c_void_p),
    **dict.fromkeys(("hypot", "atan2"), _function),
    **dict.fromkeys(_VALUES, _double),
    **{"change_max": _double, "low": _double * 3, "high": _double * 3},
    **dict.fromkeys(("low_height", "lift_off"), _double),
    **dict.fromkeys(("time_step", "robot_radius", "acceleration_max", "probe_radius"), _double),
    **dict.fromkeys(("step_ns", "check_steps", "obstacle_count", "gap_steps"), _int64),
    **{"contact_size": _int64, "stopped": _double * ACTUATORS_MAX},
    **{"is_off": _int64, "is_over": _int64, "ground": _double},
    **{"now_ns": _int64, "until_ns": _int64},
    **{"track_until_ns": _int64, "wanted": _double * 3, "yaw_rate": _double},
    **{"force_peak": _double, "impulse": _double, "reference": _double * 3},
    **dict.fromkeys(("touching", "steps", "is_news", "free_steps"), _int64),
    **{"speeds": _double * ACTUATORS_MAX, "before": _double * 13},
}


@cache
def _atan2() -> Any:
    """Return what C calls as Python's `math.atan2`: the C library's, if both give the same bits.

    This call takes a tenth of the time of a call of Python.
    """
    try:
        found = _function(ctypes.cast(ctypes.CDLL(None).atan2, ctypes.c_void_p).value or 0)
    except (OSError, AttributeError):
        return _function(math.atan2)
    tries = [(math.sin(k), math.cos(k * k)) for k in range(200)]
    same = all(found(*each) == math.atan2(*each) for each in tries)
    return found if same else _function(math.atan2)


class StepState(ctypes.Structure):
    """The C structure `StepState`; `step.h` explains its fields."""

    _fields_ = tuple(_FIELDS.items())


class Twin(ABC):
    """What the twin in C of an onboard controller and its actuators needs.

    Attributes:
        control: Which of the library's `controls` it is.
        block: Its structure in C: constants and memory.
        acceleration_max: Limit of the robot's acceleration in the air [m/s^2]. If it is infinite,
            C never leaves out the search for contacts.
    """

    control: ClassVar[str]
    block: ctypes.Structure
    acceleration_max: float

    @abstractmethod
    def __init__(self, simulator: Simulator, onboard: Any) -> None:
        """Fill the constants of the block."""

    @abstractmethod
    def give(self) -> bool:
        """Write the controller's memory to the block; return whether it has one."""

    @abstractmethod
    def take(self) -> None:
        """Read the controller's memory from the block."""


def make_state(simulator: Simulator, guard: Guard, twin: Twin) -> StepState:
    """Make the C structure `StepState`; fill all fields except the present state of the robot.

    Call `make_state` after a reset of the simulator. Raise an OSError, AttributeError or
    ValueError if this version of MuJoCo lacks a part that `step.c` needs.
    """
    model, data = simulator.model, simulator.data
    address = simulator.force_address
    force = np.zeros(1) if address is None else data.sensordata[address:]
    arrays = data.qpos, data.qvel, data.ctrl, data.qfrc_applied, force
    free_model = without_contacts(model, {sensor.address for sensor in simulator.sensors})
    obstacles, radius = boxes_around(model, data)
    if twin.acceleration_max == math.inf:
        radius = math.inf
    probe = data.site_xpos[simulator.probe].ctypes.data if simulator.probe >= 0 else None
    low_height = guard.box[0][2] - FLOOR_MARGIN + rules.LOW_HEIGHT
    mujoco = mujoco_library()
    flight = StepState(
        ctypes.cast(mujoco.mj_step, ctypes.c_void_p),
        # MuJoCo has no public name for the addresses.
        *(model._address, free_model._address, data._address),
        *(array.ctypes.data for array in arrays),
        *(data._address + contacts_offset(), None, None, None),
        *(simulator.bodies.buffer_info()[0], simulator.touched.buffer_info()[0], probe),
        ctypes.addressof(ctypes.c_void_p.in_dll(mujoco, "mjcb_time")),
        obstacles.ctypes.data,
        *(library().controls[twin.control], ctypes.addressof(twin.block), _HYPOT, _atan2()),
        *(state.OVERTURNED_COSINE, rules.SINK_LEAD_MAX, rules.FENCE_REACTION, rules.REACTION),
        *(rules.FAR, rules.RETURN_GAIN, rules.RETURN_SPEED_MAX, rules.LOW_SPEED),
        *(guard.stop_coefficient, guard.acceleration_max * STEP, *guard.box),
        *(low_height, guard.take_off.lift_off),
        *(simulator.dt, radius, twin.acceleration_max, simulator.probe_radius, STEP_NS),
        *(CONTACT_CHECK_STEPS, len(obstacles), simulator.gap_steps),
    )
    flight.keep = obstacles, free_model, force, twin  # else Python frees their memory
    return flight


_TRACK = StepState.now_ns.offset  # times, too: an argument costs more than a field of this block
_FOUND = StepState.force_peak.offset
_REFERENCE = StepState.reference.offset
_OFF = StepState.is_off.offset
_BEFORE = StepState.before.offset
_pack_track, _unpack_before = Struct("3q6d").pack_into, Struct("13d").unpack_from
_pack_off = Struct("2qd").pack_into


def accelerate(twin: type[Twin], robot: str, build: Build) -> Accelerator:
    """Return what runs the usual steps of robots with this twin in C, if this machine can.

    `robot` is a shipped robot, which flies the self-test with the parts that `build` makes for its
    compiled `MjModel`. Give always the same function: the test runs once for each.
    """
    found = usable(twin, robot, build)
    return Accelerator(partial(_make, twin) if found.run else None, found.text, found.code)


def usable(twin: type[Twin], robot: str, build: Build) -> Library:
    """Return the compiled library; its field `run` is None if it is missing or fails the self-test.

    `step.c` simulates neither wind nor a true robot that differs from its model.
    """
    found = library()
    if found.run is None or not (wrong := _self_test(twin, robot, build)):
        return found
    return Library(None, wrong)


def _make(twin: type[Twin], simulator: Simulator, onboard: Onboard, guard: Guard) -> Robot:
    if simulator.model.nu > ACTUATORS_MAX:
        return Robot(simulator, onboard, guard)
    return NativeRobot(simulator, onboard, guard, twin)


class NativeRobot(Robot):
    """A `Robot` that simulates usual steps in C (`step.c`) and all others in Python.

    In a usual step the robot follows a fresh command that the guard need not limit, or stands on
    the ground, switched off. No step runs in C while the robot has observers, or while
    `Simulator.tape` records the controls of each step.
    """

    def __init__(
        self, simulator: Simulator, onboard: Onboard, guard: Guard, twin: type[Twin]
    ) -> None:
        super().__init__(simulator, onboard, guard)
        self._twin = twin(simulator, onboard)
        self._flight = make_state(simulator, guard, self._twin)
        self._flight.stopped[: len(onboard.stopped)] = onboard.stopped
        self._address = ctypes.addressof(self._flight)
        run = library().run
        assert run is not None
        self._run_steps = run
        speeds = f"{simulator.model.nu}d"
        self._pack_state = Struct(f"3d4q{speeds}").pack_into
        self._unpack_found = Struct(f"5d3q8x{speeds}").unpack_from
        self._in_c = False  # whether C has the newest state of the controller

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn with stopped actuators, and record the reason `cause`."""
        self._in_c = False
        super().put_on_ground(now_ns, cause)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run steps from `tick_ns` up to `until_ns`; return the time of the next step [ns].

        C runs the steps while the robot is switched off, and while it follows a fresh command that
        the guard need not limit. Python runs the first other step, and all steps after it.
        """
        guard, twin, take_off = self.guard, self._twin, self.guard.take_off
        in_c = not self.observers and self.simulator.tape is None
        if in_c and guard.state is GROUND:
            tick_ns = self._stand(tick_ns, until_ns)
        while in_c and (track := guard.plain_track(tick_ns)):
            next_ns, wanted, track_ns = track
            if not self._in_c:
                if not twin.give():
                    break
                self._give_state()
            if is_taking_off := not take_off.over:
                self._give_take_off(is_off=False)
            stop_ns = next_ns if next_ns < until_ns else until_ns
            tick_ns = self._run_in_c(tick_ns, stop_ns, wanted, track_ns)
            if is_taking_off:
                take_off.rise(is_over=bool(self._flight.is_over))
            if tick_ns >= until_ns:
                return tick_ns
            in_c = tick_ns >= stop_ns  # else C has left a step to Python
        if self._in_c:
            twin.take()
            self._in_c = False
        return super().run(tick_ns, until_ns)

    def _run_in_c(self, tick_ns: int, stop_ns: int, wanted: Vector, track_ns: int) -> int:
        """Run steps in C up to `stop_ns`, or to the first that Python has to do; return its time.

        `wanted` is the commanded velocity [m/s]. The robot may follow it up to `track_ns` [ns].
        """
        simulator, guard, (x, y, z) = self.simulator, self.guard, wanted
        # fmt: off
        _pack_track(
            self._flight, _TRACK, tick_ns, stop_ns, track_ns, x, y, z, guard.yaw_rate,
            simulator.force_peak, simulator.impulse,
        )
        # fmt: on
        while steps := self._run_steps(self._address):
            tick_ns += steps * STEP_NS
            self._in_c = True
            # fmt: off
            (
                peak, impulse, x, y, z, contacts, total, news, *speeds,
            ) = self._unpack_found(self._flight, _FOUND)
            # fmt: on
            guard.reference, before = (x, y, z), None
            if news:
                numbers = _unpack_before(self._flight, _BEFORE)
                before = Readings.of(numbers[:7], numbers[7:])
            simulator.take_over(tuple(speeds), peak, impulse, contacts, total, before)
            if news and not self._flight.contact_geoms:
                self._show_contacts()
            if tick_ns >= stop_ns:
                break
        return tick_ns

    def _stand(self, tick_ns: int, until_ns: int) -> int:
        """Run steps of a robot that is switched off in C; return the time of the next step [ns]."""
        guard = self.guard
        stop_ns = guard.stands_until(tick_ns, until_ns)
        if stop_ns <= tick_ns:
            return tick_ns
        self.onboard.reset()
        self._give_state()
        self._give_take_off(is_off=True)
        tick_ns = self._run_in_c(tick_ns, stop_ns, ZERO, NEVER_NS)
        self._in_c, self._flight.is_off = False, False
        guard.take_off.stand(self._flight.before[2])
        return tick_ns

    def _give_state(self) -> None:
        """Tell C what Python's own steps have changed."""
        simulator = self.simulator
        state = *self.guard.reference, simulator.contacts, simulator.steps, 0, 0
        self._pack_state(self._flight, _REFERENCE, *state, *simulator.actuators.speeds)

    def _give_take_off(self, *, is_off: bool) -> None:
        _pack_off(self._flight, _OFF, is_off, False, self.guard.take_off.height)

    def _show_contacts(self) -> None:
        """Tell C where MuJoCo keeps the contacts; the place stays, but only a contact shows it."""
        flight, contact = self._flight, self.simulator.data.contact
        if len(contact.exclude):
            flight.contact_geoms = contact.geom.ctypes.data
            flight.contact_place = contact.pos.ctypes.data
            flight.contact_excluded = contact.exclude.ctypes.data
            flight.contact_size = contact.geom.strides[0]


@cache
def _self_test(twin: type[Twin], robot: str, build: Build) -> str:
    """Fly in C and in Python; return how the results differ, in words; "" if they are equal."""
    wrong = ""
    try:
        parts = [_parts(robot, build) for _ in range(2)]
        if _fly(Robot(*parts[0])) != _fly(NativeRobot(*parts[1], twin)):
            wrong = "C and Python differ"
    except (OSError, AttributeError, ValueError) as error:
        wrong = f"MuJoCo is not as expected: {error!r}"
    if wrong:
        logging.getLogger("cloudrc").warning("all steps run in Python: %s; report this", wrong)
    return wrong


def _parts(robot: str, build: Build) -> tuple[Simulator, Onboard, Guard]:
    files = ResolvedWorld(robot=robot, scene="empty").files
    onboard, actuators = build(files.compiled)
    simulator = Simulator(files.compiled, actuators, probe=files.robot.probe)
    return simulator, onboard, Guard(ResolvedGuard(), files.fence)


def _fly(robot: Robot) -> list[object]:
    """Fly the self-test: 0.8 s with take-off and curves; return the states on the way."""
    robot.put_on_ground(0, "self-test")
    flies, seen = robot.guard.fence.ground is None, list[object]()
    for now_ns in range(0, 800_000_000, 5 * STEP_NS):
        share = now_ns * 1e-9
        if now_ns == 20_000_000:
            robot.guard.start_mission(now_ns)
        climb = (3.0 if share < 0.5 else -0.1) if flies else 0.0
        velocity = (2.0 * share, 1.0 - share, climb)
        robot.guard.accept_command(Command(0, now_ns, 0, velocity, 0.0), now_ns)
        robot.run(now_ns, now_ns + 5 * STEP_NS)
        seen += [robot.simulator.readings, robot.guard.reference, robot.simulator.actuators.speeds]
    return seen
