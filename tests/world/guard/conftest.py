# SPDX-License-Identifier: Apache-2.0

"""Helpers for tests of the guard: a guard alone, and a flying robot with hostile clouds."""

from math import hypot
from random import Random

import pytest

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import RobotLimits
from cloudrc.physics.sim.readings import Readings
from cloudrc.robots.pelican.low_level import LowLevel
from cloudrc.wire.messages import UPRIGHT, ZERO, Command, GuardState
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import Robot
from tests.fences import FENCE
from tests.world.conftest import simulate

MS = 1_000_000
TICK = 2 * MS
DT = 0.002
SECOND = 1000 * MS
HERE = (1.0, 2.0, 1.3)
LIMITS = ResolvedGuard()


def command(velocity=(1.0, 0.0, 0.0), basis_ns=0, yaw_rate=0.0):
    return Command(0, basis_ns, 0, velocity, yaw_rate)


def sensed(position=HERE, velocity=ZERO):
    return Readings.of((*position, *UPRIGHT), (*velocity, *ZERO))


def armed(limits=LIMITS, now_ns=0, fence=FENCE, **robot):
    """Return a guard in GROUND with a started mission."""
    guard = Guard(limits, fence, RobotLimits(**robot))
    guard.start_mission(now_ns)
    return guard


def tracking(velocity=(1.0, 0.0, 0.0), limits=LIMITS):
    """Return a guard in TRACK since 0 ns, by a command with a basis of 0 ns."""
    guard = armed(limits)
    assert guard.accept_command(command(velocity), 0) is None
    return guard


def run(guard, start_ns, end_ns, position=HERE, velocity=ZERO):
    """Tick with constant readings; return the references."""
    return [
        guard.step(now_ns, sensed(position, velocity), DT)
        for now_ns in range(start_ns, end_ns, TICK)
    ]


def feed(guard, start_ns, count, velocity=(1.0, 0.0, 0.0), position=HERE, moves=ZERO):
    """Give fresh commands and tick, with constant readings; return the time after the last one."""
    now_ns = start_ns
    for _ in range(count):
        guard.accept_command(command(velocity, basis_ns=now_ns), now_ns)
        run(guard, now_ns, now_ns + 10 * MS, position, moves)
        now_ns += 10 * MS
    return now_ns


def holding(limits=LIMITS):
    """Return a guard in HOLD in a mission, at rest, at 2 s."""
    guard = tracking(limits=limits)
    run(guard, 0, 2000 * MS)
    assert guard.state is GuardState.HOLD
    return guard


def landing(limits=LIMITS):
    """Return a guard in LAND after impossible commands, at 2 s."""
    return bring_down(holding(limits), 2 * SECOND)


def bring_down(guard, now_ns):
    """Return the guard in LAND after five impossible commands."""
    for _ in range(5):
        guard.accept_command(command((float("nan"), 0.0, 0.0), now_ns), now_ns)
    assert guard.state is GuardState.LAND
    return guard


def stopped(guard):
    guard.stop(0)
    assert guard.state is GuardState.ESTOP
    return guard


def states(guard):
    return [change.state for change in guard.take_changes()]


@pytest.fixture(scope="module")
def simulator():
    return simulate("pelican", "empty")


UP = (0.0, 0.0, 1.0)


class Flight:
    """A robot in free air, commanded at 100 Hz."""

    parts = (10,)
    """Parts of a period [ms] in which the robot runs, as arrivals of commands divide it."""

    def __init__(self, simulator, robot=None):
        self.robot = robot or Robot(simulator, LowLevel(), Guard(LIMITS, FENCE))
        self.guard, self.now_ns = self.robot.guard, 0
        self.robot.put_on_ground(0, "test")
        self.guard.start_mission(0)
        self.room = 9.0  # smallest distance to a wall or the ceiling [m]

    @property
    def readings(self):
        return self.robot.simulator.readings

    @property
    def speed(self):
        return hypot(*self.readings.velocity)

    def fly(self, seconds, policy=None):
        """Fly on; the policy gives velocities or commands, None means silence."""
        for _ in range(round(seconds * 100)):
            sent = policy(self) if callable(policy) else policy
            if sent is not None:
                if type(sent) is not Command:
                    sent = Command(0, self.now_ns, 0, sent, 0.0)
                self.guard.accept_command(sent, self.now_ns)
            for part in self.parts:
                self.robot.run(self.now_ns, self.now_ns + part * MS)
                self.now_ns += part * MS
            self.look()
        return self

    def look(self):
        """Measure after each period."""
        x, y, z = self.readings.position
        (ax, ay, _), (bx, by, bz) = FENCE.low, FENCE.high
        self.room = min(self.room, x - ax, bx - x, y - ay, by - y, bz - z)


def hostile(seed):
    """Make a policy that jumps between extreme velocities at random times."""
    rng, until_ns, velocity = Random(seed), 0, UP

    def policy(flight):
        nonlocal until_ns, velocity
        if flight.now_ns >= until_ns:
            until_ns = flight.now_ns + rng.choice((20, 50, 200, 500, 1000, 3000)) * MS
            velocity = tuple(rng.choice((-9.0, -3.0, 0.0, 3.0, 9.0)) for _ in range(3))
        return velocity

    return policy
