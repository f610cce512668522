# SPDX-License-Identifier: Apache-2.0

"""A robot that runs its usual steps in C, and all others in Python, with the same results.

In a usual step the robot follows a fresh command that the guard need not limit. Python and `step.c`
share the structure `StepState`: constants, MuJoCo's addresses, present state. The onboard
controller has a structure of its own, which its `Twin` makes.
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
from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.geometry.obstacles import fence_of
from cloudrc.geometry.scene import load_scene
from cloudrc.messages import Command
from cloudrc.robots.native.library import Library, library
from cloudrc.sim.memory import boxes_around, contacts_offset, mujoco_library, without_contacts
from cloudrc.sim.onboard import Accelerator, Actuators, Onboard
from cloudrc.sim.readings import Readings
from cloudrc.sim.scene import compile_model
from cloudrc.sim.simulator import CONTACT_CHECK_STEPS, Simulator
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard import state
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import STEP, STEP_NS, Robot

ACTUATORS_MAX = 16
"""Largest number of actuators that the structures of C hold."""
_POINTERS = (
    *("mj_step", "model", "free_model", "data", "qpos", "qvel", "ctrl", "applied"),
    *("probe_force", "contacts", "timer", "obstacles", "control", "controller"),
)
_function = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double, ctypes.c_double)
_HYPOT, _ATAN2 = _function(math.hypot), _function(math.atan2)
Build: TypeAlias = Callable[[Any], tuple[Onboard, Actuators]]
"""Makes onboard controller and actuators for a compiled `MjModel`."""
_double, _int64 = ctypes.c_double, ctypes.c_int64
_VALUES = ("overturned_cosine", "sink_lead_max", "fence_reaction", "reaction", "stop_coefficient")
_FIELDS: dict[str, Any] = {
    **dict.fromkeys(_POINTERS, ctypes.c_void_p),
    **dict.fromkeys(("hypot", "atan2"), _function),
    **dict.fromkeys(_VALUES, _double),
    **{"change_max": _double, "low": _double * 3, "high": _double * 3},
    **dict.fromkeys(("time_step", "robot_radius", "acceleration_max"), _double),
    **dict.fromkeys(("step_ns", "check_steps", "obstacle_count"), _int64),
    **{"now_ns": _int64, "until_ns": _int64},
    **{"reference": _double * 3, "wanted": _double * 3, "yaw_rate": _double},
    **{"track_until_ns": _int64, "force_peak": _double, "impulse": _double},
    **dict.fromkeys(("touching", "steps", "is_news", "free_steps"), _int64),
    **{"speeds": _double * ACTUATORS_MAX, "before": _double * 13},
}


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
    mujoco = mujoco_library()
    flight = StepState(
        ctypes.cast(mujoco.mj_step, ctypes.c_void_p),
        # MuJoCo has no public name for the addresses.
        *(model._address, free_model._address, data._address),
        *(array.ctypes.data for array in arrays),
        data._address + contacts_offset(),
        ctypes.addressof(ctypes.c_void_p.in_dll(mujoco, "mjcb_time")),
        obstacles.ctypes.data,
        *(library().controls[twin.control], ctypes.addressof(twin.block), _HYPOT, _ATAN2),
        *(state.OVERTURNED_COSINE, rules.SINK_LEAD_MAX, rules.FENCE_REACTION, rules.REACTION),
        *(guard.stop_coefficient, guard.acceleration_max * STEP, *guard.box),
        *(simulator.dt, radius, twin.acceleration_max, STEP_NS),
        *(CONTACT_CHECK_STEPS, len(obstacles)),
    )
    flight.keep = obstacles, free_model, force, twin  # else Python frees their memory
    return flight


_TRACK = StepState.now_ns.offset  # times, too: an argument costs more than a field of this block
_MEMORY = StepState.free_steps.offset
_BEFORE = StepState.before.offset
_pack_track, _unpack_before = Struct("2q7dq2d2q").pack_into, Struct("13d").unpack_from


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

    In a usual step the robot follows a fresh command that the guard need not limit. No step runs in
    C while the robot has observers, or while `Simulator.tape` records the controls of each step.
    """

    def __init__(
        self, simulator: Simulator, onboard: Onboard, guard: Guard, twin: type[Twin]
    ) -> None:
        super().__init__(simulator, onboard, guard)
        self._twin = twin(simulator, onboard)
        self._flight = make_state(simulator, guard, self._twin)
        self._address = ctypes.addressof(self._flight)
        run = library().run
        assert run is not None
        self._run_steps = run
        speeds = f"{simulator.model.nu}d"
        self._pack_memory = Struct(f"q{speeds}").pack_into
        self._unpack_track = Struct(f"16x3d40x2d3q8x{speeds}").unpack_from
        self._in_c = False  # whether C has the newest state of the controller

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn with stopped actuators, and record the reason `cause`."""
        self._in_c = False
        super().put_on_ground(now_ns, cause)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run steps from `tick_ns` up to `until_ns`; return the time of the next step [ns].

        C runs the steps while the robot follows a fresh command that the guard need not limit.
        Python runs the first other step, and all steps after it.
        """
        simulator, guard, twin = self.simulator, self.guard, self._twin
        in_c = not self.observers and simulator.tape is None
        while in_c and (track := guard.plain_track(tick_ns)):
            next_ns, reference, wanted, track_ns = track
            stop_ns = next_ns if next_ns < until_ns else until_ns
            force = simulator.force_peak, simulator.impulse
            counts = simulator.contacts, simulator.steps
            # fmt: off
            _pack_track(
                self._flight, _TRACK, tick_ns, stop_ns, *reference, *wanted, guard.yaw_rate,
                track_ns, *force, *counts,
            )
            # fmt: on
            if not self._in_c:
                if not twin.give():
                    break
                self._pack_memory(self._flight, _MEMORY, 0, *simulator.actuators.speeds)
            while steps := self._run_steps(self._address):
                tick_ns += steps * STEP_NS
                self._in_c = True
                # fmt: off
                (
                    x, y, z, peak, impulse, contacts, total, news, *speeds,
                ) = self._unpack_track(self._flight, _TRACK)
                # fmt: on
                guard.reference, before = (x, y, z), None
                if news:
                    numbers = _unpack_before(self._flight, _BEFORE)
                    before = Readings.of(numbers[:7], numbers[7:])
                simulator.take_over(tuple(speeds), peak, impulse, contacts, total, before)
                if tick_ns >= stop_ns:
                    break
            if tick_ns >= until_ns:
                return tick_ns
            in_c = tick_ns >= stop_ns  # else C has left a step to Python
        if self._in_c:
            twin.take()
            self._in_c = False
        return super().run(tick_ns, until_ns)


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
    files = find_robot(robot)
    model = compile_model(files.model, file_of("empty"))
    onboard, actuators = build(model)
    fence = fence_of(load_scene("empty"), planar=files.planar)
    simulator = Simulator(model, actuators, probe=files.probe)
    return simulator, onboard, Guard(ResolvedGuard(), fence)


def _fly(robot: Robot) -> list[object]:
    """Fly the self-test: 0.8 s with take-off and curves; return the states on the way."""
    robot.put_on_ground(0, "self-test")
    robot.guard.start_mission(0)
    flies, seen = robot.guard.fence.ground is None, list[object]()
    for now_ns in range(0, 800_000_000, 5 * STEP_NS):
        share = now_ns * 1e-9
        climb = (3.0 if share < 0.5 else -0.1) if flies else 0.0
        velocity = (2.0 * share, 1.0 - share, climb)
        robot.guard.accept_command(Command(0, now_ns, 0, velocity, 0.0), now_ns)
        robot.run(now_ns, now_ns + 5 * STEP_NS)
        seen += [robot.simulator.readings, robot.guard.reference, robot.simulator.actuators.speeds]
    return seen
