"""Lanes that share one thread and one wait: what a relay does from wake to wake.

It sleeps until shortly before the next datagram is due, looks at the clock until it is, sends what
is due, and only then takes in what has come: that has its kernel's stamp and can wait.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from time import monotonic_ns, sleep

from cloudrc.link.relay_errors import Recent, ReleaseErrors
from cloudrc.link.relay_lane import Lane
from cloudrc.link.relay_lead import Lead
from cloudrc.link.relay_wait import Wait, best_wait

_DEFER_NS = 60_000
"""So shortly before it has to wake for a release a relay does not begin to take in [ns]."""


class Lanes:
    """Lanes that share one thread and one wait."""

    def __init__(self, lanes: Sequence[Lane], origin_ns: int | None) -> None:
        """Set up.

        Args:
            lanes: At least one.
            origin_ns: What their models count time from [ns], on the machine's monotonic clock;
                None: from the first datagram, as in virtual time, whatever it takes to start.
        """
        self._lanes = tuple(lanes)
        self._lead = Lead()
        self._recent = Recent()
        self._wait: Wait = best_wait([lane.source.socket for lane in self._lanes])
        self._origin_known = False
        self._tell_origin(origin_ns)

    def step(self, timeout: float) -> None:
        """Wait for a datagram or a due instant, at most `timeout` [s], and handle what is there."""
        readable = self._sleep(timeout)
        for lane in self._lanes:
            lane.release()
        if not readable:
            return
        for lane in self._lanes:
            if lane.source.socket.fileno() in readable:
                lane.take_in()
                if not self._origin_known:
                    self._tell_origin(lane.origin_ns)
                lane.release()  # where there is no delay

    def close(self) -> None:
        """Give back what the wait needs; the sockets stay their owners' to close."""
        self._wait.close()

    def outcomes(self) -> dict[str, int]:
        """Count the datagrams of all lanes by what became of them.

        `received`; `lost` on the link by any cause; `malformed`; `overflow` beyond
        `in_flight_max`; `unread` because the kernel had no room for them in the socket (it tells
        so with the next one that it has room for); `unsent` because the other end is unknown or
        the kernel refused; `forwarded`, copies included.
        """
        outcomes: Counter[str] = Counter()
        for lane in self._lanes:
            outcomes.update(lane.counts())
        return dict(outcomes)

    def recent(self) -> dict[str, int]:
        """Say how late datagrams left of late, as `Recent.counts`; to be asked once a second."""
        return self._recent.counts(self._errors())

    def counts(self) -> dict[str, float]:
        """Say what has happened so far, on all lanes together.

        `outcomes`, `released_early`, and `release_error_p50`, `_p99` and `_p999`: how late
        datagrams left since the beginning [s]; absent before the first.
        """
        errors = self._errors()
        return {**self.outcomes(), "released_early": errors.early, **errors.quantiles()}

    def _errors(self) -> ReleaseErrors:
        return ReleaseErrors.together(lane.errors for lane in self._lanes)

    def _sleep(self, timeout: float) -> Sequence[int]:
        """Sleep until a socket can be read, or until the next datagram is due."""
        dues_ns = [due_ns for lane in self._lanes if (due_ns := lane.due_ns()) is not None]
        if not dues_ns:
            return tuple(self._wait.until(None, timeout))
        due_ns, lead = min(dues_ns), self._lead
        ahead_ns = lead.ahead_ns()
        wake_ns = due_ns - ahead_ns
        asleep_ns = monotonic_ns()
        readable = tuple(self._wait.until(wake_ns, timeout))
        now_ns = monotonic_ns()
        if now_ns < wake_ns - _DEFER_NS:
            return readable
        if now_ns < wake_ns:
            # What has come has its stamp: to take it in now could make the other one late.
            sleep((wake_ns - now_ns) * 1e-9)
            now_ns = monotonic_ns()
        if asleep_ns < wake_ns and not readable:
            lead.woke(now_ns - wake_ns)
        if now_ns < due_ns:
            since_ns = now_ns
            while now_ns < due_ns:
                now_ns = monotonic_ns()
            lead.looked(since_ns, now_ns)
        elif not ahead_ns:
            lead.rests(now_ns)
        return readable

    def _tell_origin(self, origin_ns: int | None) -> None:
        if origin_ns is not None:
            self._origin_known = True
            for lane in self._lanes:
                lane.origin_ns = origin_ns
