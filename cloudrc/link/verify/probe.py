"""Sends numbered probes through both directions of a link and notes when each copy arrives.

One thread, one clock: both ends of the link are sockets of this process. Instants of sending are
read just before the kernel takes a probe, instants of arrival are the kernel's own, so that what
this process waits for in between is no part of a delay.
"""

from __future__ import annotations

import gc
import select
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field

from cloudrc.link.relay import ANCILLARY_SIZE, Stamps, ask_for_stamps, instant_ns
from cloudrc.link.verify.measure import Log

Address = tuple[str, int]
Write = Callable[[int, int], bytes]
"""Makes the header of a probe from its kind and its number."""
Read = Callable[[bytes], tuple[int, int, int]]
"""Kind, epoch and number of a datagram; raises ValueError if it is not one of ours."""

DRAIN_MAX = 64
"""Datagrams that are read from one socket before the other has its turn."""
_DATAGRAM_MAX = 2048
_WAIT_MAX = 0.1
_BUFFER = 4_000_000
"""Asked for each socket [bytes]; the kernel may give less."""


@dataclass(frozen=True, slots=True)
class Volley:
    """Probes of one kind.

    Attributes:
        kind: In their headers.
        size: Of each, UDP payload [bytes].
        period_ns: From one salvo to the next [ns].
        count: Salvos.
        length: Probes in a salvo, which leave at once; 1 where each leaves alone.
    """

    kind: int
    size: int
    period_ns: int
    count: int
    length: int = 1


class Shore:
    """One end of the link: a socket that sends one direction's probes and hears the other's."""

    def __init__(self, own: socket.socket, route: Address, write: Write) -> None:
        """Set up; the socket stays the caller's to close.

        Args:
            own: Bound UDP socket.
            route: Where it has to send.
            write: Makes headers.
        """
        own.setblocking(False)
        own.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        ask_for_stamps(own)
        self.socket = own
        self.route = route
        self.write = write
        self.stamps = Stamps()


@dataclass(slots=True)
class _Course:
    """A volley under way."""

    shore: Shore
    volley: Volley
    begin_ns: int
    log: Log = field(default_factory=Log)
    salvos: int = 0

    def due_ns(self) -> int | None:
        """When the next salvo leaves [ns]; None if all have."""
        if self.salvos == self.volley.count:
            return None
        return self.begin_ns + self.salvos * self.volley.period_ns

    def fire(self) -> None:
        """Send one salvo."""
        shore, volley, sent_ns = self.shore, self.volley, self.log.sent_ns
        self.salvos += 1
        for _ in range(volley.length):
            data = shore.write(volley.kind, len(sent_ns)).ljust(volley.size, b"\0")
            sent_ns.append(time.monotonic_ns())
            with suppress(OSError):  # then it does not arrive
                shore.socket.sendto(data, shore.route)


def sound(
    shores: Sequence[Shore],
    volleys: Sequence[Volley | None],
    read: Read,
    *,
    begin_ns: int,
    quiet: float,
    tell: Callable[[float], None] = lambda share: None,
) -> list[Log]:
    """Send a volley from each shore and listen until nothing has come for a while.

    Args:
        shores: Both ends: what the first sends the second hears, and the other way round.
        volleys: What each sends; None sends nothing.
        read: Takes headers apart.
        begin_ns: When the first salvos leave [ns], monotonic clock.
        quiet: For how long nothing may come before it is over [s].
        tell: Hears now and then which share of the time has passed, in [0, 1].

    Returns:
        One log per shore: of what it sent, and of what the other heard of it.
    """
    courses = [
        _Course(shore, volley or Volley(0, 0, 1, 0), begin_ns)
        for shore, volley in zip(shores, volleys, strict=True)
    ]
    heard = {
        shore.socket: (shore.stamps, course)
        for shore, course in zip(shores, reversed(courses), strict=True)
    }
    gc.collect()
    gc.disable()  # a collection takes milliseconds
    try:
        _run(courses, heard, read, round(quiet * 1e9), tell)
    finally:
        gc.enable()
    return [course.log for course in courses]


def _run(
    courses: Sequence[_Course],
    heard: _Heard,
    read: Read,
    quiet_ns: int,
    tell: Callable[[float], None],
) -> None:
    """Send what is due and note what comes, until all is sent and nothing comes any more."""
    begin_ns, told = courses[0].begin_ns, 0.0
    until_ns = max(begin_ns + c.volley.count * c.volley.period_ns for c in courses)
    while True:
        dues = [due_ns for course in courses if (due_ns := course.due_ns()) is not None]
        now_ns = time.monotonic_ns()
        if not dues and now_ns > until_ns + quiet_ns:
            break
        wait = (min(dues) - now_ns) * 1e-9 if dues else _WAIT_MAX
        if _listen(heard, read, min(max(wait, 0.0), _WAIT_MAX)) and not dues:
            until_ns = max(until_ns, now_ns)
        for course in courses:
            due_ns = course.due_ns()
            if due_ns is not None and due_ns <= time.monotonic_ns():
                course.fire()
        share = (now_ns - begin_ns) / max(1, until_ns - begin_ns)
        if share >= told + 0.01:
            told = share
            tell(min(share, 1.0))


_Heard = Mapping[socket.socket, tuple[Stamps, _Course]]
"""By socket: how its stamps are read, and whose probes it hears."""


def _listen(heard: _Heard, read: Read, wait: float) -> int:
    """Wait for probes, at most so long [s], and note them; say how many have come."""
    readable, _, _ = select.select(list(heard), (), (), wait)
    total = 0
    for one in readable:
        stamps, course = heard[one]
        offset_ns = stamps.look_at_clocks()
        for _ in range(DRAIN_MAX):
            try:
                data, ancillary, _, _ = one.recvmsg(_DATAGRAM_MAX, ANCILLARY_SIZE)
            except BlockingIOError:
                break
            except OSError:  # an earlier probe found nobody listening
                continue
            at_ns = instant_ns(stamps.wall_ns(ancillary), offset_ns, time.monotonic_ns())
            total += _note(course, read, data, at_ns)
    return total


def _note(course: _Course, read: Read, data: bytes, at_ns: int) -> int:
    """Note the arrival of a probe of this course; whatever else comes is ignored."""
    try:
        kind, _, number = read(data)
    except ValueError:
        return 0
    if kind != course.volley.kind or number >= len(course.log.sent_ns):
        return 0
    course.log.arrivals.append((number, at_ns))
    return 1
