"""A robot that runs its usual steps in C, and all others in Python, with the same results."""

from __future__ import annotations

import ctypes
import logging
from functools import cache
from struct import Struct

from cloudrc.geometry import fence
from cloudrc.messages import Command, Vector
from cloudrc.world.guard.limits import Limits
from cloudrc.world.guard.state import Guard
from cloudrc.world.low_level import LowLevel
from cloudrc.world.native.flight import Flight, make_flight
from cloudrc.world.native.library import Library, library
from cloudrc.world.readings import Readings
from cloudrc.world.robot import STEP_NS, Robot
from cloudrc.world.simulator import Simulator

_TRACK, _MEMORY, _BEFORE = Flight.reference.offset, Flight.free_steps.offset, Flight.before.offset
_pack_track, _unpack_track = Struct("6dq2d2q").pack_into, Struct("3d32x2d3q8x4d").unpack_from
_pack_memory, _unpack_memory = Struct("q10dq").pack_into, Struct("40x6d").unpack_from
_unpack_before = Struct("13d").unpack_from


def make_robot(simulator: Simulator, low_level: LowLevel, guard: Guard, limits: Limits) -> Robot:
    """Make a robot that uses C if this machine can; `limits` are those of the guard.

    `step.c` has neither wind nor a true robot that differs from its model.
    """
    if usable().run is None or not simulator.is_nominal:
        return Robot(simulator, low_level, guard)
    return NativeRobot(simulator, low_level, guard, limits)


def usable() -> Library:
    """Return the library; without its function if the self-test of this process has failed."""
    found = library()
    return found if found.run is None or not (wrong := _self_test()) else Library(None, wrong)


class NativeRobot(Robot):
    """A `Robot` whose usual steps `step.c` runs.

    In a usual step the robot follows a fresh command that the guard need not limit. Python runs all
    other steps, and every step while the robot has observers or the simulator has a tape.
    """

    def __init__(
        self, simulator: Simulator, low_level: LowLevel, guard: Guard, limits: Limits
    ) -> None:
        """Connect the parts; `limits` are those of the guard."""
        super().__init__(simulator, low_level, guard)
        self._flight = make_flight(simulator, low_level, limits, STEP_NS)
        self._address = ctypes.addressof(self._flight)
        run = library().run
        assert run is not None
        self._run_steps = run
        self._in_c = False  # whether C has the newest state of the controller

    def put_on_ground(self, now_ns: int, cause: str) -> None:
        """Reset the robot to its spawn, as `Robot` does."""
        self._in_c = False
        super().put_on_ground(now_ns, cause)

    def run(self, tick_ns: int, until_ns: int) -> int:
        """Run steps, as `Robot` does: the first ones in C, if they are usual steps."""
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
        """Give C the state before its first step; the arguments are from `Guard.plain_track`."""
        simulator = self.simulator
        tip = simulator.tip_force_peak, simulator.tip_impulse
        counts = simulator.contacts, simulator.steps
        _pack_track(self._flight, _TRACK, *reference, *wanted, track_ns, *tip, *counts)
        if not self._in_c:
            integral, error = self._low_level.integral, self._low_level.error
            memory = (*integral, *(error or integral), error is not None)
            _pack_memory(self._flight, _MEMORY, 0, *simulator.rotor_speeds, *memory)

    def _before(self) -> Readings:
        numbers = _unpack_before(self._flight, _BEFORE)
        return Readings.of(numbers[:7], numbers[7:])


@cache
def _self_test() -> str:
    """Fly in C and in Python; return how the results differ, in words, or an empty text."""
    limits = Limits(fence.LOW, fence.HIGH)
    parts = [(Simulator("pelican", "empty"), LowLevel(), Guard(limits)) for _ in range(2)]
    wrong = ""
    try:
        if _fly(Robot(*parts[0])) != _fly(NativeRobot(*parts[1], limits)):
            wrong = "C and Python differ"
    except (OSError, AttributeError, KeyError, ImportError) as error:
        wrong = f"MuJoCo is not as expected: {error!r}"
    if wrong:
        logging.getLogger("cloudrc").warning("all steps run in Python: %s; report this", wrong)
    return wrong


def _fly(robot: Robot) -> list[object]:
    """Take off and fly curves for 0.8 s; return the states of robot and guard."""
    robot.put_on_ground(0, "self-test")
    robot.guard.start_mission(0)
    seen: list[object] = []
    for now_ns in range(0, 800_000_000, 5 * STEP_NS):
        share = now_ns * 1e-9
        velocity = (2.0 * share, 1.0 - share, 3.0 if share < 0.5 else -0.1)
        robot.guard.accept_command(Command(0, now_ns, 0, velocity, 0.0), now_ns)
        robot.run(now_ns, now_ns + 5 * STEP_NS)
        seen += [robot.simulator.readings, robot.guard.reference, robot.simulator.rotor_speeds]
    return seen
