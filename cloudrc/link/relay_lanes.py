"""Lanes that share one thread and one wait: what a relay does from wake to wake.

It sleeps until shortly before the next datagram is due, looks at the clock until it is, sends what
is due, and only then takes in what has come: that has its kernel's stamp and can wait. Where every
delay is long it is not even woken by what comes, but looks in time: half the wakes, which cost more
than all else.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from time import monotonic_ns, sleep

from cloudrc.link.relay_errors import Recent, ReleaseErrors
from cloudrc.link.relay_lane import Lane
from cloudrc.link.relay_lead import Lead
from cloudrc.link.relay_priority import runs_first
from cloudrc.link.relay_wait import Wait, best_wait

_DEFER_NS = 60_000
"""So shortly before it has to wake for a release a relay does not begin to take in [ns]."""
_SLACK_NS = 2_000_000
"""By so much it looks sooner than it has to, so that what it does then is done in time [ns]."""
_UNWATCHED_MIN_NS = 2_000_000
_UNWATCHED_MAX_NS = 20_000_000
"""Shortest and longest time for which it is not woken by what comes [ns]. The longest is well below
`relay_stamps.AGE_MAX_NS`, and a socket of usual size takes 10,000 datagrams a second meanwhile."""
_TAKING_NS = 300_000
"""What taking in a few may take [ns]: if a datagram is due before, that leaves first."""
_FEW = 6
"""If more datagrams than this have come at once it is woken by each, for a second."""
_WATCH_NS = 1_000_000_000


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
        self._sources = tuple(lane.source.socket.fileno() for lane in self._lanes)
        self._looked_ns = self._watched_ns = 0
        self._lead = Lead(first=runs_first())
        self._recent = Recent()
        self._wait: Wait = best_wait([lane.source.socket for lane in self._lanes])
        self._origin_known = False
        self._tell_origin(origin_ns)

    def step(self, timeout: float) -> None:
        """Wait for a datagram or a due instant, at most `timeout` [s], and handle what is there."""
        due_ns = self._due_ns()
        if due_ns is None:
            self._take_in(tuple(self._wait.until(None, timeout)))
            return
        patience_ns = self._patience_ns(monotonic_ns())
        if patience_ns:
            self._step_unwatched(due_ns, self._looked_ns + patience_ns)
            return
        readable = self._sleep(due_ns, timeout)
        self._release()
        self._take_in(readable)

    def _step_unwatched(self, due_ns: int, look_ns: int) -> None:
        """Release what is due next, or look at the sockets, which is to be done by `look_ns`."""
        now_ns = monotonic_ns()
        if due_ns < max(look_ns, now_ns) + _TAKING_NS:
            self._sleep_unwatched(due_ns)
            self._release()
            next_ns = self._due_ns()
            if next_ns is None or next_ns < max(look_ns, monotonic_ns()) + _TAKING_NS:
                return  # there is a wake before the look has to be, or nothing under way
        elif now_ns < look_ns:
            sleep((look_ns - now_ns) * 1e-9)
        self.take_in()

    def _due_ns(self) -> int | None:
        dues_ns = [due_ns for lane in self._lanes if (due_ns := lane.due_ns()) is not None]
        return min(dues_ns) if dues_ns else None

    def run(self, timeout: float) -> None:
        """Step for `timeout` [s], or a little longer."""
        until_ns = monotonic_ns() + round(timeout * 1e9)
        while (rest_ns := until_ns - monotonic_ns()) > 0:
            self.step(rest_ns * 1e-9)

    def take_in(self) -> None:
        """Put on the link whatever has come."""
        self._take_in(self._sources)

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

    def _patience_ns(self, now_ns: int) -> int:
        """Say for how long nobody need be woken by what comes [ns]; 0: not even shortly."""
        if now_ns < self._watched_ns:
            return 0
        patience_ns = min([lane.patience_ns for lane in self._lanes]) - _SLACK_NS
        return min(patience_ns, _UNWATCHED_MAX_NS) if patience_ns > _UNWATCHED_MIN_NS else 0

    def _release(self) -> None:
        for lane in self._lanes:
            lane.release()

    def _take_in(self, readable: Sequence[int]) -> None:
        """Take in what waits in these sockets."""
        self._looked_ns = monotonic_ns()
        for lane, source in zip(self._lanes, self._sources, strict=True):
            if source in readable:
                if lane.take_in() > _FEW:
                    self._watched_ns = self._looked_ns + _WATCH_NS
                if not self._origin_known:
                    self._tell_origin(lane.origin_ns)
                lane.release()  # where there is no delay

    def _sleep(self, due_ns: int, timeout: float) -> Sequence[int]:
        """Sleep until a socket can be read, or until a datagram is due."""
        wake_ns = due_ns - self._lead.ahead_ns()
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
            self._lead.woke(now_ns - wake_ns)
        self._spin(wake_ns, due_ns, now_ns)
        return readable

    def _sleep_unwatched(self, due_ns: int) -> None:
        """Sleep until a datagram is due, whatever comes."""
        wake_ns = due_ns - self._lead.ahead_ns()
        now_ns = monotonic_ns()
        if now_ns < wake_ns:
            sleep((wake_ns - now_ns) * 1e-9)
            now_ns = monotonic_ns()
            self._lead.woke(now_ns - wake_ns)
        self._spin(wake_ns, due_ns, now_ns)

    def _spin(self, wake_ns: int, due_ns: int, now_ns: int) -> None:
        """Look at the clock until a datagram is due."""
        if now_ns < due_ns:
            since_ns = now_ns
            while now_ns < due_ns:
                now_ns = monotonic_ns()
            self._lead.looked(since_ns, now_ns)
        elif wake_ns == due_ns:
            self._lead.rests(now_ns)

    def _tell_origin(self, origin_ns: int | None) -> None:
        if origin_ns is not None:
            self._origin_known = True
            for lane in self._lanes:
                lane.origin_ns = origin_ns
