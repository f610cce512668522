# SPDX-License-Identifier: Apache-2.0

"""Inject faults of processes and clocks in virtual time, by models of them."""

from __future__ import annotations

from bisect import insort
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from signal import SIGKILL, SIGSTOP
from typing import TYPE_CHECKING, Any

from cloudrc.config.faults import (
    CLOUD_KILLED,
    CLOUD_PAUSED,
    OF_CLOCK,
    TELEOP_KILLED,
    WORLD_PAUSED,
    FaultConfig,
    acting,
)
from cloudrc.flight.virtual.run import Clock
from cloudrc.physics.geometry.fence import Fence
from cloudrc.teleop.mission import Teleop
from cloudrc.teleop.store import MissionRecord
from cloudrc.teleop.wire import Output, RobotStatus
from cloudrc.wire.endpoint import Endpoint
from cloudrc.wire.messages import Datagram
from cloudrc.wire.records import MissionEvent, Record

if TYPE_CHECKING:
    pass

FAR_NS = 1 << 62
SOCKET_MAX = 256
"""Number of datagrams that the socket of a frozen process can hold: Linux' default buffer."""


@dataclass(frozen=True, slots=True)
class FaultyClock(Clock):
    """Clock that steps or drifts in flight: from each time on [ns, virtual], another clock."""

    pieces: tuple[tuple[int, Clock], ...] = ()  # the earliest first

    def at(self, now_ns: int) -> int:
        """Return the time that this clock shows [ns] at the virtual time `now_ns` [ns]."""
        clock = next(each for start_ns, each in reversed(self.pieces) if start_ns <= now_ns)
        return clock.at(now_ns)

    def when(self, own_ns: int) -> int:
        """Return the first virtual time [ns] at which this clock shows `own_ns` [ns] or more."""
        for (start_ns, clock), (end_ns, _) in pairwise((*self.pieces, (FAR_NS, self))):
            now_ns = max(clock.when(own_ns), start_ns)
            if now_ns < end_ns:
                break
        return now_ns


def faulty_clock(clock: Clock, faults: Iterable[FaultConfig]) -> Clock:
    """Return cloud's clock with its faults; without any, `clock` itself."""
    changes = list[tuple[int, int, int]]()  # time [ns], step [ns], more drift [ppm]
    for fault in acting(faults, *OF_CLOCK):
        begin_ns, end_ns, drift = _ns(fault.at_s), _ns(fault.end), fault.drift_ppm or 0
        changes.append((begin_ns, _ns(fault.step_s or 0.0), drift))
        if drift:
            changes.append((end_ns, 0, -drift))
    pieces = [(-FAR_NS, clock)]
    for at_ns, step_ns, drift in sorted(changes):
        before = pieces[-1][1]
        after = Clock(0, before.drift_ppm + drift)
        offset_ns = before.at(at_ns) + step_ns - after.at(at_ns)
        pieces.append((at_ns, Clock(offset_ns, after.drift_ppm)))
    return FaultyClock(clock.offset_ns, clock.drift_ppm, tuple(pieces)) if changes else clock


class RestartableEndpoint:
    """An `Endpoint`: world or cloud in a process that faults can kill, freeze and start.

    Attributes:
        inner: World or cloud; None while there is no process.
        now_ns: Time of the last event [ns], virtual time.
    """

    def __init__(self, first: Endpoint, build: Callable[[int], Endpoint], clock: Clock) -> None:
        """Run `first`; `build` makes that of a new process, given the time on `clock` [ns]."""
        self.inner: Endpoint | None = first
        self._build, self.clock, self.now_ns = build, clock, 0
        self._frozen_until_ns = -1
        self._waiting = list[Datagram]()
        self._left = list[Record]()
        self._actions = list[tuple[int, Callable[..., None], tuple[Any, ...]]]()

    def at(self, seconds: float, action: Callable[..., None], *args: Any) -> None:
        """Schedule an action with `args` at the virtual time `seconds` [s]."""
        insort(self._actions, (_ns(seconds), action, args), key=itemgetter(0))

    def kill(self) -> None:
        """Kill the process as with SIGKILL; its records so far are kept."""
        self._left = self.take_records()
        self.inner, self._frozen_until_ns = None, -1
        self._waiting.clear()

    def start(self) -> None:
        """Start a new process of world or cloud."""
        self.inner = self._build(self.clock.at(self.now_ns))

    def freeze(self, duration: float) -> None:
        """Stop the process as with SIGSTOP for `duration` [s]."""
        self._frozen_until_ns = max(self._frozen_until_ns, self.now_ns + _ns(duration))

    def receive_datagram(self, data: Datagram, now_ns: int) -> None:
        """Implement `Endpoint.receive_datagram`."""
        self.pass_on(data, now_ns)

    def pass_on(self, data: Datagram, now_ns: int) -> None:
        """Pass a datagram to the process; keep it while the process is frozen."""
        if self.inner is None:
            return
        if self._frozen_until_ns <= now_ns:
            self.inner.receive_datagram(data, self.clock.at(now_ns))
        elif len(self._waiting) < SOCKET_MAX:
            self._waiting.append(data)

    def next_deadline_ns(self) -> int:
        """Implement `Endpoint.next_deadline_ns`."""
        due_ns = self._actions[0][0] if self._actions else FAR_NS
        if self.inner is None:
            return due_ns
        if self._frozen_until_ns >= 0:
            return min(due_ns, self._frozen_until_ns)
        return min(due_ns, self.clock.when(self.inner.next_deadline_ns()))

    def handle_deadline(self, now_ns: int) -> None:
        """Implement `Endpoint.handle_deadline`: inject due faults, then run the process."""
        self.now_ns = now_ns
        while self._actions and self._actions[0][0] <= now_ns:
            _, act, args = self._actions.pop(0)
            act(*args)
        if 0 <= self._frozen_until_ns <= now_ns:
            self._frozen_until_ns = -1
            waiting, self._waiting = self._waiting, []
            for data in waiting:
                self.pass_on(data, now_ns)
        own_ns, inner = self.clock.at(now_ns), self.inner
        if inner is not None and self._frozen_until_ns < 0 and own_ns >= inner.next_deadline_ns():
            inner.handle_deadline(own_ns)

    def take_datagrams(self) -> list[Datagram]:
        """Return the datagrams of the process; none while it is frozen or does not run."""
        if self.inner is None or self._frozen_until_ns >= 0:
            return []
        return self.inner.take_datagrams()

    def take_records(self) -> list[Record]:
        """Return and remove the records since the last call, also those of a killed process."""
        left, self._left = self._left, []
        return left if self.inner is None else left + self.inner.take_records()


class RestartableTeleop(Teleop):
    """Teleop in a process that faults kill; what it knows of its mission is kept, as on a disk.

    In virtual time cloud calls it: the fault begins and ends with such a call.
    """

    def __init__(self, fence: Fence, down_ns: Iterable[tuple[int, int]]) -> None:
        """Begin without a mission; `down_ns` is when no process runs [ns], on cloud's clock."""
        super().__init__(fence)
        self._fence, self._down_ns = fence, list(down_ns)

    def start(self, now_ns: int, mission: MissionRecord) -> None:
        """Fly a mission, and keep its record."""
        self._mission = mission
        super().start(now_ns, mission)

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Process telemetry if the process runs."""
        if self._runs(now_ns):
            super().see(seen, now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Do what is due if the process runs."""
        if self._runs(now_ns):
            super().handle_deadline(now_ns)

    def take_outputs(self) -> list[Output]:
        """Return the messages for cloud, after the events among them are kept."""
        outputs, flight, mission = super().take_outputs(), self.flight, self._mission
        for event in outputs:
            if isinstance(event, MissionEvent) and flight is not None:
                changed: dict[str, Any] = {"elapsed": flight.elapsed(event.stamp_ns)}
                if event.event == "started" and self.seen is not None:
                    changed["world"] = self.seen.world
                mission.apply(0, event.event, event.text, **changed)
        return outputs

    def _runs(self, now_ns: int) -> bool:
        """Start a new process if it is time; return whether one runs."""
        down_ns = self._down_ns
        while down_ns and now_ns >= down_ns[0][1]:
            del down_ns[0]
            if not self._mission.ended:
                super().__init__(self._fence)
                super().start(now_ns, self._mission)
        return self._mission.ended or not down_ns or now_ns < down_ns[0][0]


def teleop_of(fence: Fence, faults: Sequence[FaultConfig], clock: Clock) -> Teleop:
    """Make teleop, in a process that `faults` kill; `clock` is that of cloud."""
    kills = acting(faults, TELEOP_KILLED)
    spans = [(clock.at(_ns(each.at_s)), clock.at(_ns(each.end))) for each in kills]
    return RestartableTeleop(fence, spans) if spans else Teleop(fence)


def disturbed(
    first: Endpoint,
    build: Callable[[int], Endpoint],
    faults: Sequence[FaultConfig],
    clock: Clock,
) -> Endpoint:
    """Put world or cloud into a process which `faults` disturb; without any, return it as it is.

    Args:
        first: World or cloud.
        build: Makes it anew, given the time on `clock` [ns].
        faults: Those that hit it.
        clock: Clock of this end; the driver gives the endpoint its times.
    """
    if not faults:
        return first
    process = RestartableEndpoint(first, build, Clock())
    for fault in faults:
        begin, over = (clock.at(_ns(instant)) * 1e-9 for instant in (fault.at_s, fault.end))
        if fault.kind == CLOUD_KILLED:
            process.at(begin, process.kill)
            process.at(over, process.start)
        else:
            process.at(begin, process.freeze, over - begin)
    return process


SIGNALS = {
    CLOUD_KILLED: ("cloud", SIGKILL),
    CLOUD_PAUSED: ("cloud", SIGSTOP),
    TELEOP_KILLED: ("teleop", SIGKILL),
    WORLD_PAUSED: ("world", SIGSTOP),
}
"""Kind of fault -> process, and the signal that it gets at the begin."""


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
