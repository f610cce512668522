"""A robot in free air under the guard, and clouds that command it."""

from __future__ import annotations

from math import hypot
from random import Random

from guard_play import LIMITS, MS, SECOND

from cloudrc.geometry import fence
from cloudrc.messages import Command
from cloudrc.world.guard.state import Guard
from cloudrc.world.low_level import LowLevel
from cloudrc.world.robot import Robot

PERIOD_NS = 10 * MS
UP = (0.0, 0.0, 1.0)


class Flight:
    """A robot in free air, commanded at 100 Hz."""

    def __init__(self, simulator, limits=LIMITS):
        self.guard = Guard(limits)
        self.robot = Robot(simulator, LowLevel(), self.guard)
        self.robot.put_on_ground(0, "test")
        self.guard.start_mission(0)
        self.now_ns = 0
        self.room = 9.0  # smallest distance to a wall or the ceiling [m]

    @property
    def readings(self):
        return self.robot.simulator.readings

    @property
    def speed(self):
        return hypot(*self.readings.velocity)

    def fly(self, seconds, policy=None):
        """Go on; a policy gives the command, None is silence."""
        for _ in range(round(seconds * SECOND / PERIOD_NS)):
            if policy is not None:
                velocity = policy(self) if callable(policy) else policy
                self.guard.offer(Command(0, self.now_ns, 0, velocity, 0.0), self.now_ns)
            self.robot.run(self.now_ns, self.now_ns + PERIOD_NS)
            self.now_ns += PERIOD_NS
            x, y, z = self.readings.position
            (ax, ay, _), (bx, by, bz) = fence.LOW, fence.HIGH
            self.room = min(self.room, x - ax, bx - x, y - ay, by - y, bz - z)
        return self


def hostile(seed):
    """Jumps between extremes, at random instants."""
    rng, until_ns, velocity = Random(seed), 0, UP

    def policy(flight):
        nonlocal until_ns, velocity
        if flight.now_ns >= until_ns:
            until_ns = flight.now_ns + rng.choice((20, 50, 200, 500, 1000, 3000)) * MS
            velocity = tuple(rng.choice((-9.0, -3.0, 0.0, 3.0, 9.0)) for _ in range(3))
        return velocity

    return policy
