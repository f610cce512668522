"""What one direction of a flight is judged by: a profile comes in; of what was heard, rows go out.

By the link's own draws where they fit, by statistics where they do not; while a time line runs, by
what it asks for at that time.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import nan
from typing import NamedTuple

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.timeline import settled
from cloudrc.link.verify_block import Block
from cloudrc.link.verify_expect import JITTER_SHARES, has_jitter
from cloudrc.link.verify_judge import Row
from cloudrc.link.verify_origin import LATER, length
from cloudrc.link.verify_standing import RECENT, Standing, excused, make_standing
from cloudrc.link.verify_story import judge_story
from cloudrc.link.verify_twin import SAME_SHARE, Compared, Heard, Stream, Twin

RARELY = 3
"""What is as drawn is compared again every so many periods."""
LOOKS_MAX = 60
"""A time line is compared in every period, but not for ever: for 5 min."""


class Judged(NamedTuple):
    """Rows, and how many datagrams they rest on."""

    rows: list[Row]
    datagrams: int


class Basis:
    """What is asked of the direction that an end hears, and how that is found out.

    Attributes:
        standing: Judges sums, once a time line is over.
        changing_ns: For so long after the first datagram a time line may be running [ns].
    """

    def __init__(
        self,
        own: DirectionProfile,
        other: DirectionProfile | None,
        stream: Stream,
        breathe: Callable[[], None] = lambda: None,
    ) -> None:
        """Work it out; takes a second or two.

        Args:
            own: Asked of the direction that is heard.
            other: Of the other, if this end measures round trips.
            stream: Whose draws are heard.
            breathe: Lets others run.
        """
        self._profile, self._stream = own, stream
        self._length = length(own)
        self._twin = Twin(own, stream, breathe)
        # The other's time line may be running still: round trips are judged where there is none.
        steady = other if other is not None and not length(other) else None
        self.standing: Standing = make_standing(settled(own), stream.size, steady)
        self.changing_ns = round((self._length + LATER) * 1e9) if self._length else 0
        self._compared: Compared | None = None
        self._story: list[Row] = []
        self._watched = 0.0
        self._sessions = self._looks = 0

    def worth(self, changing: bool) -> bool:
        """Say, once per period, whether it is worth while to compare single datagrams again."""
        self._looks += 1
        compared = self._compared
        if compared is None or (changing and self._looks <= LOOKS_MAX):
            return True
        # Who draws otherwise, as netem does, goes on doing so; what is as drawn is hardly news.
        return compared.same > SAME_SHARE and (not compared.decided or not self._looks % RARELY)

    def compare(self, epoch: int, heard: Sequence[Heard]) -> None:
        """Compare single datagrams with their drawn fates; takes some 10 ms, 1 s at most."""
        session = self._sessions
        compared = self._twin.compare(epoch, heard)
        story: list[Row] = []
        if compared is not None and self._length:
            if compared.same <= SAME_SHARE and compared.pairs.timed.any():
                story = judge_story(self._profile, compared.pairs, self._stream.size)
            if compared.decided or (story and {row.verdict for row in story} == {"ok"}):
                self._watch(compared)
        if session == self._sessions:
            self._compared, self._story = compared, story

    def forget(self) -> None:
        """What was compared belongs to another session."""
        self._compared, self._story = None, []
        self._sessions += 1
        self._looks = 0

    def _watch(self, compared: Compared) -> None:
        """Note how much of the time line was as asked."""
        begin, end = (min(self._length, at) for at in compared.pairs.sent[[0, -1]].tolist())
        self._watched = max(self._watched, (end - max(0.0, begin)) / self._length)

    def judge_changing(self, lateness: Block) -> Judged:
        """Judge while a time line may be running, by single datagrams alone."""
        compared = self._compared
        if compared is None:
            return Judged([self._time_line()], 0)
        rows = [excused(row, lateness) for row in self._story or compared.rows]
        return Judged([*rows, self._time_line(), *self._rate()], len(compared.pairs.sent))

    def judge(self, whole: Block, recent: Block) -> Judged:
        """Judge a link whose conditions do not change any more.

        Args:
            whole: Sums over the window.
            recent: Over the newest of it, by which what is far off is told sooner.
        """
        compared, standing = self._compared, self.standing
        rows, count = standing.rows(whole), whole.sent
        if compared is not None and compared.decided:
            rows, count = _joined(rows, compared), len(compared.pairs.sent)
        elif whole.sent > recent.sent >= RECENT:
            newest = {row.name: row for row in standing.rows(recent) if row.verdict == "off"}
            rows = [newest.get(row.name, row) for row in rows]
        beside = [*self._rate()]
        if compared is None or not compared.decided:
            beside += self._progress(whole)
        if self._length:
            beside.append(self._time_line())
        return Judged([*rows, *beside], count)

    def _progress(self, whole: Block) -> list[Row]:
        """Tell how many datagrams decide, and by which share the jitter may be off."""
        needs, share = self.standing.needs, self.standing.expects.share
        rows = [_told("datagrams", needs, whole.sent)]
        if has_jitter(self._profile) and share != JITTER_SHARES[0]:
            rows.append(_told("jitter_share", JITTER_SHARES[0], share))
        return rows

    def _time_line(self) -> Row:
        return _told("time_line", 1.0, self._watched)

    def _rate(self) -> list[Row]:
        """Tell of a bottleneck, which datagrams that come alone cannot measure."""
        rates = [self._profile.rate, *(change.rate for change in self._profile.changes)]
        return [_told("rate", rate, nan) for rate in rates if rate][:1]


def _joined(rows: list[Row], compared: Compared) -> list[Row]:
    """Take what draws prove; without a shared clock that is no delay."""
    if compared.pairs.timed.any():
        return compared.rows
    proven = {row.name: row for row in compared.rows}
    return [proven.get(row.name, row) for row in rows]


def _told(name: str, asked: float, measured: float) -> Row:
    return Row(name, "1", float(asked), nan, float(measured), nan, nan, "told")
