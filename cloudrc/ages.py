"""Simulate how old commands and their confirmations become, before a flight.

The delays are those of the flight, because link and cloud draw the same random numbers.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, TypeAlias

from cloudrc.assembly import build_compute_time
from cloudrc.config.robot import known_robot
from cloudrc.link.model import LinkDirection
from cloudrc.link.queue import PacketQueue
from cloudrc.link.traces import link_profile
from cloudrc.messages import plan_length
from cloudrc.tunnel.codec import COMMAND_SIZES, TELEMETRY_SIZES, Kind

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment

DURATION_NS = 20_000_000_000
"""Simulated time [ns]."""
NEVER_NS = -1
"""Stamp of a datagram that no end has received yet [ns]."""
Datagram: TypeAlias = tuple[int, int]
"""Stamp of a datagram, and the stamp that it confirms [ns]."""


class _Way:
    """One direction of the link, with the stream of datagrams that cross it.

    Attributes:
        newest: The datagram that the far end uses; None before the first.
    """

    def __init__(
        self, link: LinkDirection, kind: Kind, size: int, rate_hz: int, *, newest_wins: bool
    ) -> None:
        self._link, self._kind, self._size, self._newest_wins = link, kind, size, newest_wins
        self._period_ns, self._due_ns = round(1e9 / rate_hz), 0
        self.newest: Datagram | None = None

    def is_due(self, now_ns: int) -> bool:
        """Whether an end that is free sends a datagram now: once per period."""
        if now_ns < self._due_ns:
            return False
        self._due_ns = self.next_period_ns(now_ns)
        return True

    def next_period_ns(self, now_ns: int) -> int:
        """Return when the next period begins [ns]."""
        return (now_ns // self._period_ns + 1) * self._period_ns

    def send(self, queue: PacketQueue, datagram: Datagram, now_ns: int) -> None:
        """Send a datagram at `now_ns` [ns]."""
        count = datagram[0] // self._period_ns
        queue.put(self, self._link.send(1, self._kind, count, self._size, now_ns), datagram)

    def arrive(self, datagram: Datagram) -> None:
        """Take a datagram at the far end."""
        if self.newest is None or datagram[0] > self.newest[0] or not self._newest_wins:
            self.newest = datagram


def simulate_ages(experiment: ResolvedExperiment) -> tuple[list[float], list[float]]:
    """Simulate telemetry and commands over the experiment's link, without its blackouts.

    While cloud computes a command, it begins no other one.

    Return two lists of ages [s]: of the odometry from which cloud computed the command that world
    follows, and of the newest command that telemetry has confirmed. Both have an age at each
    departure and arrival of a datagram, just before it.
    """
    plan = plan_length(experiment.cloud.plan_s)
    newest_wins = experiment.tunnel.order == "newest" or plan > 0
    up = _Way(
        _always_up(experiment, uplink=True),
        Kind.TELEMETRY,
        TELEMETRY_SIZES[len(known_robot(experiment.world.robot).sensors)],
        experiment.world.odometry_rate_hz,
        newest_wins=newest_wins,
    )
    down = _Way(
        _always_up(experiment, uplink=False),
        Kind.COMMAND,
        COMMAND_SIZES[plan],
        experiment.cloud.command_rate_hz,
        newest_wins=newest_wins,
    )
    queue, compute = PacketQueue(), build_compute_time(experiment)
    ages, echoes = list[float](), list[float]()
    now_ns = free_ns = 0  # cloud has sent its last command at `free_ns`
    while now_ns < DURATION_NS:
        _deliver(queue, now_ns)
        if up.is_due(now_ns):
            up.send(queue, (now_ns, NEVER_NS if down.newest is None else down.newest[0]), now_ns)
            _deliver(queue, now_ns)
        if now_ns >= free_ns and down.is_due(now_ns) and up.newest is not None:
            free_ns = now_ns + (0 if compute is None else compute.end())
            down.send(queue, (now_ns, up.newest[0]), free_ns)
            _deliver(queue, now_ns)
        next_ns = min(queue.next_ns, *(way.next_period_ns(now_ns) for way in (up, down)))
        if now_ns < free_ns:
            next_ns = min(next_ns, free_ns)
        if down.newest is not None:
            ages.append((next_ns - down.newest[1]) * 1e-9)
        if up.newest is not None and up.newest[1] != NEVER_NS:
            echoes.append((next_ns - up.newest[1]) * 1e-9)
        now_ns = next_ns
    return ages, echoes


def _deliver(queue: PacketQueue, now_ns: int) -> None:
    """Let all datagrams arrive that are due at `now_ns` [ns]."""
    while queue.next_ns <= now_ns:
        _, way, datagram = queue.pop()
        way.arrive(datagram)


def _always_up(experiment: ResolvedExperiment, *, uplink: bool) -> LinkDirection:
    """Return a direction of the experiment's link without blackouts and without damage."""
    way = experiment.uplink if uplink else experiment.downlink
    way = way.model_copy(update={"blackouts": (), "corrupt": 0.0})
    return LinkDirection(link_profile(way), experiment.seed, uplink)
