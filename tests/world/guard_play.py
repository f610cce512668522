"""A guard without a robot: commands, readings and time as a test writes them."""

from __future__ import annotations

from cloudrc.geometry import fence
from cloudrc.messages import UPRIGHT, ZERO, Command, GuardState, Vector
from cloudrc.world.guard.limits import Limits
from cloudrc.world.guard.state import Guard
from cloudrc.world.readings import Readings

MS = 1_000_000
TICK = 2 * MS
DT = 0.002
SECOND = 1000 * MS
HERE = (1.0, 2.0, 1.3)
LIMITS = Limits(fence.LOW, fence.HIGH)


def command(velocity: Vector = (1.0, 0.0, 0.0), basis_ns: int = 0, yaw_rate: float = 0.0):
    """A command that was computed from odometry of `basis_ns`."""
    return Command(0, basis_ns, 0, velocity, yaw_rate)


def sensed(position: Vector = HERE, velocity: Vector = ZERO) -> Readings:
    """What the sensors of an upright robot say."""
    return Readings.of((*position, *UPRIGHT), (*velocity, *ZERO))


def armed(limits: Limits = LIMITS, now_ns: int = 0) -> Guard:
    """On the ground, its mission started."""
    guard = Guard(limits)
    guard.start_mission(now_ns)
    return guard


def tracking(velocity: Vector = (1.0, 0.0, 0.0), limits: Limits = LIMITS) -> Guard:
    """Flying since 0 ns by a command with a basis of 0 ns."""
    guard = armed(limits)
    assert guard.offer(command(velocity), 0) is None
    return guard


def run(guard, start_ns, end_ns, position=HERE, velocity=ZERO):
    """Tick through a time with the sensors standing still; returns the references."""
    return [
        guard.tick(now_ns, sensed(position, velocity), DT)
        for now_ns in range(start_ns, end_ns, TICK)
    ]


def feed(guard, start_ns, count, velocity=(1.0, 0.0, 0.0), every_ns=10 * MS, position=HERE):
    """Offer fresh commands and tick; returns the instant after the last one."""
    now_ns = start_ns
    for _ in range(count):
        guard.offer(command(velocity, basis_ns=now_ns), now_ns)
        run(guard, now_ns, now_ns + every_ns, position)
        now_ns += every_ns
    return now_ns


def holding(limits: Limits = LIMITS):
    """In HOLD since 252 ms, at rest since; a mission is on."""
    guard = tracking(limits=limits)
    run(guard, 0, 2000 * MS)
    assert guard.state is GuardState.HOLD
    return guard


def landing(limits: Limits = LIMITS):
    """In LAND because of impossible commands; at 2 s."""
    guard = holding(limits)
    for _ in range(5):
        guard.offer(command((float("nan"), 0.0, 0.0)), 2000 * MS)
    assert guard.state is GuardState.LAND
    return guard


def states(guard):
    """The states entered since the last call."""
    return [change.state for change in guard.take_changes()]
