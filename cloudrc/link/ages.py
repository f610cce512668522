"""Simulate how old commands and their confirmations become on a link, before a flight.

The delays are those of the flight, because the link draws the same random numbers.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import TYPE_CHECKING, TypeAlias

from cloudrc.config.robot import known_robot
from cloudrc.link.model import LinkDirection
from cloudrc.link.queue import PacketQueue
from cloudrc.link.traces import link_profile
from cloudrc.messages import plan_length
from cloudrc.tunnel.codec import COMMAND_SIZES, TELEMETRY_SIZES, Kind

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment

DURATION_NS = 20_000_000_000
"""Simulated time of the link [ns]."""
NEVER_NS = -1
"""Stamp of a datagram that no end has received yet [ns]."""
Datagram: TypeAlias = tuple[int, int]
"""Stamp of a datagram, and the stamp that it confirms [ns]."""


class _Way:
    """One direction of the link, with the stream of datagrams that cross it."""

    def __init__(self, link: LinkDirection, kind: Kind, size: int, rate_hz: int) -> None:
        self.link, self._kind, self._size = link, kind, size
        self.period_ns = round(1e9 / rate_hz)
        self.newest: Datagram | None = None  # that has arrived

    def arrive(self, datagram: Datagram, *, newest_wins: bool) -> None:
        """Take a datagram at the far end."""
        if self.newest is None or datagram[0] > self.newest[0] or not newest_wins:
            self.newest = datagram

    def send(
        self, queue: PacketQueue, now_ns: int, confirmed: Datagram | None, wait_ns: int = 0
    ) -> None:
        """Send a datagram if one is due; it leaves after `wait_ns`, the time to compute it [ns]."""
        count, early_ns = divmod(now_ns, self.period_ns)
        if early_ns == 0:
            datagram = now_ns, NEVER_NS if confirmed is None else confirmed[0]
            queue.send(self.link, (self._kind, 1, count), self._size, datagram, now_ns + wait_ns)


def simulate_ages(experiment: ResolvedExperiment) -> tuple[list[float], list[float]]:
    """Simulate telemetry and commands over the experiment's link, without its blackouts.

    Return two lists of ages [s]: of the odometry from which cloud computed the command that world
    follows, and of the newest command that telemetry has confirmed. Both have an age for each
    datagram that is sent, at its departure.
    """
    plan = plan_length(experiment.cloud.plan_s)
    newest_wins = experiment.tunnel.order == "newest" or plan > 0
    up = _Way(
        _always_up(experiment, uplink=True),
        Kind.TELEMETRY,
        TELEMETRY_SIZES[len(known_robot(experiment.world.robot).sensors)],
        experiment.world.odometry_rate_hz,
    )
    down = _Way(
        _always_up(experiment, uplink=False),
        Kind.COMMAND,
        COMMAND_SIZES[plan],
        experiment.cloud.command_rate_hz,
    )
    queue, compute_ns = PacketQueue(), round(experiment.cloud.compute_ms * 1e6)
    ages, echoes = list[float](), list[float]()
    for now_ns, next_ns in pairwise(_times_ns((up.period_ns, down.period_ns))):
        while queue.next_ns <= now_ns:
            _, link, datagram = queue.pop()
            way = up if link is up.link else down
            way.arrive(datagram, newest_wins=newest_wins)
        telemetry, command = up.newest, down.newest
        if command is not None:
            ages.append((next_ns - command[1]) * 1e-9)
        if telemetry is not None and telemetry[1] != NEVER_NS:
            echoes.append((next_ns - telemetry[1]) * 1e-9)
        up.send(queue, now_ns, command)
        if telemetry is not None:
            down.send(queue, now_ns, telemetry, compute_ns)
    return ages, echoes


def _times_ns(periods_ns: Iterable[int]) -> list[int]:
    """Return the times at which a datagram of one of the streams is due [ns], in order."""
    return sorted({time for period in periods_ns for time in range(0, DURATION_NS, period)})


def _always_up(experiment: ResolvedExperiment, *, uplink: bool) -> LinkDirection:
    """Return a direction of the experiment's link without blackouts and without damage."""
    way = experiment.uplink if uplink else experiment.downlink
    way = way.model_copy(update={"blackouts": (), "corrupt": 0.0})
    return LinkDirection(link_profile(way), experiment.seed, uplink)
