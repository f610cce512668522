# SPDX-License-Identifier: Apache-2.0

"""A robot that runs its usual steps in C, and all others in Python, with the same results.

In a usual step the robot follows a fresh command that the guard need not limit. Python and `step.c`
share the structure `StepState`: constants, MuJoCo's addresses, present state.
"""

from __future__ import annotations

import ctypes
import logging
from functools import cache
from struct import Struct
from typing import Any

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.geometry.obstacles import fence_of
from cloudrc.geometry.scene import load_scene
from cloudrc.messages import Command
from cloudrc.robots.pelican import low_level, rotors
from cloudrc.robots.pelican.low_level import LowLevel
from cloudrc.robots.pelican.native.library import Library, library
from cloudrc.sim.memory import boxes_around, contacts_offset, mujoco_library, without_contacts
from cloudrc.sim.readings import Readings
from cloudrc.sim.scene import ROBOT_PREFIX, compile_model
from cloudrc.sim.simulator import CONTACT_CHECK_STEPS, Simulator
from cloudrc.world.guard import limits as rules
from cloudrc.world.guard import state
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import STEP, STEP_NS, Robot

_POINTERS = (
    *("mj_step", "model", "free_model", "data", "qpos", "qvel", "ctrl", "applied"),
    *("tip_force", "contacts", "timer", "obstacles"),
)
ACCELERATION_MAX = 400.0
"""Limit of the robot's acceleration in the air [m/s^2]. Full thrust gives a robot that is 10 %
lighter 153 m/s^2, and a spin of 50 rad/s about a centre of mass 3 cm away gives 75 m/s^2."""
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
    **{"now_ns": _int64, "until_ns": _int64},
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
    free_model = without_contacts(model, {sensor.address for sensor in simulator.sensors})
    obstacles, radius = boxes_around(model, data)
    library = mujoco_library()
    timer = ctypes.addressof(ctypes.c_void_p.in_dll(library, "mjcb_time"))
    flight = StepState(
        ctypes.cast(library.mj_step, ctypes.c_void_p),
        # MuJoCo has no public name for the addresses.
        *(model._address, free_model._address, data._address),
        *(array.ctypes.data for array in (*arrays, tip_force)),
        *(data._address + contacts_offset(), timer, obstacles.ctypes.data),
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


_TRACK = StepState.now_ns.offset  # times, too: an argument costs more than a field of this block
_MEMORY = StepState.free_steps.offset
_BEFORE = StepState.before.offset
_pack_track, _unpack_track = Struct("2q6dq2d2q").pack_into, Struct("16x3d32x2d3q8x4d").unpack_from
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
        simulator, guard, law = self.simulator, self.guard, self._low_level
        in_c = not self.observers and simulator.tape is None
        while in_c and (track := guard.plain_track(tick_ns)):
            next_ns, reference, wanted, track_ns = track
            stop_ns = next_ns if next_ns < until_ns else until_ns
            force = simulator.force_peak, simulator.impulse
            counts = simulator.contacts, simulator.steps
            # fmt: off
            _pack_track(
                self._flight, _TRACK, tick_ns, stop_ns, *reference, *wanted, track_ns,
                *force, *counts,
            )
            # fmt: on
            if not self._in_c:
                integral, error = law.integral, law.error
                memory = (*integral, *(error or integral), error is not None)
                _pack_memory(self._flight, _MEMORY, 0, *simulator.actuators.speeds, *memory)
            while steps := self._run_steps(self._address):
                tick_ns += steps * STEP_NS
                self._in_c = True
                # fmt: off
                (
                    x, y, z, peak, impulse, contacts, total, news, front, left, back, right,
                ) = _unpack_track(self._flight, _TRACK)
                # fmt: on
                guard.reference = (x, y, z)
                before, speeds = None, (front, left, back, right)
                if news:
                    numbers = _unpack_before(self._flight, _BEFORE)
                    before = Readings.of(numbers[:7], numbers[7:])
                simulator.take_over(speeds, peak, impulse, contacts, total, before)
                if tick_ns >= stop_ns:
                    break
            if tick_ns >= until_ns:
                return tick_ns
            in_c = tick_ns >= stop_ns  # else C has left a step to Python
        if self._in_c:
            numbers = _unpack_memory(self._flight, _MEMORY)
            law.integral, law.error = numbers[:3], numbers[3:]
            self._in_c = False
        return super().run(tick_ns, until_ns)


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
