"""What one direction of a flight is judged by: a profile comes in; of what was heard, rows go out.

By the link's own draws where they fit, by statistics where they do not: of what was asked, or of
what netem makes of it; while a time line runs, by what it asks for at that time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import nan
from typing import NamedTuple

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.timeline import settled
from cloudrc.link.verify_block import Block
from cloudrc.link.verify_corrupt import refusing
from cloudrc.link.verify_ends import excused
from cloudrc.link.verify_expect import JITTER_SHARES, has_jitter
from cloudrc.link.verify_judge import Row
from cloudrc.link.verify_netem import netem_makes
from cloudrc.link.verify_origin import LATER, length
from cloudrc.link.verify_standing import RECENT, WINDOW_MAX, Standing, make_standing
from cloudrc.link.verify_story import judge_story
from cloudrc.link.verify_twin import SAME_SHARE, Compared, Heard, Stream, Twin

RARELY = 3
"""What is as drawn is compared again every so many periods."""
LOOKS_MAX = 60
"""A time line is compared in every period, but not for ever: for 5 min."""
TAKES = "_takes"
"""Ends the name of what tells how many datagrams a quantity takes that is not judged."""


class Judged(NamedTuple):
    """Rows, and how many datagrams they rest on."""

    rows: list[Row]
    datagrams: int


class Basis:
    """What is asked of the direction that an end hears, and how that is found out.

    Attributes:
        by_netem: Whether netem is known to shape. Where delays are known they tell by themselves.
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
        self.by_netem = False
        self._standing, *self._others = _standings(settled(own), steady, stream.size)
        self.changing_ns = round((self._length + LATER) * 1e9) if self._length else 0
        self._compared: Compared | None = None
        self._story: list[Row] = []
        self._watched = 0.0
        self._sessions = self._looks = 0

    def place(self, delay: float) -> float:
        """Say where in the middle a delay [s] is; see `Standing`."""
        return self._standing.place(delay)

    def window(self, *, timed: bool) -> int:
        """See `Standing`."""
        return max(one.window(timed=timed) for one in (self._standing, *self._others))

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
        beside = [self._time_line(), *self._rate(), *(self._correlation() if self._story else ())]
        return Judged([*rows, *beside], len(compared.pairs.sent))

    def judge(self, whole: Block, recent: Block) -> Judged:
        """Judge a link whose conditions do not change any more.

        Args:
            whole: Sums over the window.
            recent: Over the newest of it, by which what is far off is told sooner.
        """
        compared, standing = self._compared, self._chosen(whole)
        rows, count = standing.rows(whole), whole.sent
        if compared is not None and compared.decided:
            rows, count = _joined(rows, compared), len(compared.pairs.sent)
        elif whole.sent > recent.sent >= RECENT:
            newest = {row.name: row for row in standing.rows(recent) if row.verdict == "off"}
            rows = [newest.get(row.name, row) for row in rows]
        beside = [*self._rate()]
        if compared is None or not compared.decided or not compared.pairs.timed.any():
            beside += self._progress(whole, standing, rows)
        if self._length:
            beside.append(self._time_line())
        return Judged([*rows, *beside], count)

    def _chosen(self, whole: Block) -> Standing:
        """Choose by what the link is judged: as asked, or as netem makes it.

        Who shapes the direction that is heard is not known here, since that is done in the other
        pod; but delays that resemble the ones before, or do not, tell. Without delays the shaper of
        this pod stands for both.
        """
        if whole.timed:
            return min((self._standing, *self._others), key=lambda one: one.unlike(whole))
        return self._others[0] if self._others and self.by_netem else self._standing

    def _progress(self, whole: Block, standing: Standing, rows: list[Row]) -> Iterator[Row]:
        """Tell how many datagrams decide, what they never will, and how strictly jitter is judged.

        Args:
            whole: Sums over the window.
            standing: That judged them.
            rows: What came of it.
        """
        verdicts = {row.name: row.verdict for row in rows}
        found = [one for one in standing.needed(whole) if one.datagrams <= WINDOW_MAX]
        still = [one for one in found if verdicts.get(one.name) == "open"] or found
        yield _told("datagrams", max(one.datagrams for one in still), whole.sent)
        for one in standing.hopeless(whole):
            if verdicts.get(one.name) == "told":
                yield _told(f"{one.name}{TAKES}", one.datagrams, whole.sent)
        share = standing.expects.share
        if whole.timed and has_jitter(self._profile) and share != JITTER_SHARES[0]:
            yield _told("jitter_share", JITTER_SHARES[0], share)
        if standing is not self._standing:
            yield from self._correlation()

    def _correlation(self) -> Iterator[Row]:
        """Tell that netem makes nothing of a correlation."""
        if self._profile.correlation and has_jitter(self._profile):
            yield _told("correlation", self._profile.correlation, 0.0)

    def _time_line(self) -> Row:
        return _told("time_line", 1.0, self._watched)

    def _rate(self) -> list[Row]:
        """Tell of a bottleneck, which datagrams that come alone cannot measure."""
        rates = [self._profile.rate, *(change.rate for change in self._profile.changes)]
        return [_told("rate", rate, nan) for rate in rates if rate][:1]


def _standings(
    own: DirectionProfile, other: DirectionProfile | None, size: int
) -> Iterator[Standing]:
    """Work out what is judged by: what is asked; and what netem makes of it, if that is other."""
    yield make_standing(own, size, other)
    ours, theirs = netem_makes(own), None if other is None else netem_makes(other)
    if (ours, theirs) != (refusing(own), None if other is None else refusing(other)):
        yield make_standing(ours, size, theirs)


def _joined(rows: list[Row], compared: Compared) -> list[Row]:
    """Take what draws prove; without a shared clock that is no delay."""
    if compared.pairs.timed.any():
        return compared.rows
    proven = {row.name: row for row in compared.rows}
    return [proven.get(row.name, row) for row in rows]


def _told(name: str, asked: float, measured: float) -> Row:
    return Row(name, "1", float(asked), nan, float(measured), nan, nan, "told")
