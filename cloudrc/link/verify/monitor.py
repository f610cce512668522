"""The standing check of an end in flight: records come in; every 5 s a verdict on what it hears.

World hears the downlink, cloud the uplink and the round trips. What a datagram costs is a few sums,
made ten times a second for all that came; what is expected is worked out on a thread of its own
when the link's profile is seen or changes.

What one direction of a flight is judged by: a profile comes in; of what was heard, rows go out.

By the link's own draws where they fit, by statistics where they do not: of what was asked, or of
what netem makes of it; while a time line runs, by what it asks for at that time.

What the standing check makes of single datagrams: arrivals come in, sums and a log go out.
"""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from math import isnan, nan
from pathlib import Path
from typing import NamedTuple

from cloudrc.errors import describe_error
from cloudrc.exposition.parts import DatagramTally
from cloudrc.files import TooLongError, read
from cloudrc.link.profile import DirectionProfile, settled
from cloudrc.link.state import STATE_MAX, from_text
from cloudrc.link.verify.expect import JITTER_SHARES, has_jitter, netem_makes, refusing
from cloudrc.link.verify.judge import Row
from cloudrc.link.verify.measure import Block
from cloudrc.link.verify.standing import (
    RECENT,
    WINDOW_MAX,
    Standing,
    excused,
    judge_story,
    make_standing,
    verdict_of,
)
from cloudrc.link.verify.twin import LATER, SAME_SHARE, Compared, Heard, Stream, Twin, length
from cloudrc.records import Arrival, Control, Fault, Lateness, LinkChecked, Record
from cloudrc.tunnel.channel import LATE, REPEATED, Channel

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


HEARD_MAX = 4000
"""Datagrams that are kept one by one: those of 40 s."""
_RING = 256


def _nowhere(delay: float) -> float:
    return nan


class Tally:
    """Sums over what arrives in one direction, and its newest datagrams.

    Attributes:
        block: Sums since they were taken.
        heard: Datagrams one by one, oldest first.
        epoch: Of the session.
        place: Says where in the middle a delay is; see `Standing.place`.
    """

    def __init__(self) -> None:
        """Begin before the first datagram."""
        self.block = Block()
        self.heard: deque[Heard] = deque(maxlen=HEARD_MAX)
        self.epoch = -1
        self.place: Callable[[float], float] = _nowhere
        self._channel = Channel(newest_wins=True)
        self._stream = DatagramTally()
        self._told = (0, 0)
        self._delays: list[tuple[int, float]] = [(-1, 0.0)] * _RING

    def see(self, arrival: Arrival) -> bool:
        """Add one datagram; True if it is the first of its session."""
        stamp_ns, _, epoch, counter, delay, _ = arrival
        self._stream.take(epoch, counter)
        if epoch != self.epoch:
            self.epoch = epoch
            self._channel.reset()
            self._channel.take(counter)
            return True
        self.heard.append((stamp_ns, counter, delay))
        block, outcome = self.block, self._channel.take(counter)
        if outcome == REPEATED:
            block.copies += 1
            return False
        block.arrived += 1
        if outcome == LATE:
            block.late += 1
        if delay == delay:  # not NaN
            self._add_delay(counter, delay)
        return False

    def _add_delay(self, counter: int, delay: float) -> None:
        block, delays = self.block, self._delays
        block.timed += 1
        block.delays += delay
        block.squares += delay * delay
        place = self.place(delay)
        if place == place:
            block.inside += 1
            block.places += place
            block.place_squares += place * place
        delays[counter % _RING] = (counter, delay)
        for neighbour in (counter - 1, counter + 1):
            known, other = delays[neighbour % _RING]
            if known == neighbour:
                block.steps += abs(delay - other)
                block.pairs += 1

    def take(self) -> Block:
        """Hand over the sums and begin new ones."""
        block, self.block = self.block, Block()
        (sent, lost), self._told = self._told, (self._stream.expected, self._stream.lost)
        block.sent, block.lost = self._told[0] - sent, self._told[1] - lost
        return block

    def forget(self) -> None:
        """Begin anew, within the same session."""
        self.take()
        self.heard.clear()


PERIOD_NS = 5_000_000_000
"""From one verdict to the next [ns]."""
SUM_PERIOD_NS = 100_000_000
"""How often what has come is added up [ns]: many at once cost a third of each by itself."""
SETTLE_NS = 2_000_000_000
"""After a session began or the link changed, what arrives is not judged for so long [ns]."""
LOOK_PERIOD = 0.5
"""How often it is looked whether the link's profile has changed [s]."""

Asked = tuple[DirectionProfile, DirectionProfile]
"""Of uplink and downlink."""
Load = Callable[[object], Asked]
"""Makes uplink and downlink of the values of a profile's file; raises a CloudrcError."""


class StandingCheck:
    """Judges what one end hears."""

    def __init__(self, *, uplink: bool, stream: Stream) -> None:
        """Set up; nothing is judged before `follow`.

        Args:
            uplink: Whether this end hears the uplink: it is cloud.
            stream: What it hears: whose draws, and how large.
        """
        self._uplink, self._stream = uplink, stream
        self._tally, self._blocks = Tally(), deque[Block]()
        self._basis: Basis | None = None
        self._asked: object = None
        self._held: list[Record] = []
        self._due_ns = self._quiet_ns = self._sum_ns = self._since_ns = 0
        self._settled = False
        self._trip = float("nan")
        self._said = "ok"
        self._failure = ""  # of the thread, in words, until it has been told
        self._jobs: queue.SimpleQueue[Callable[[], None]] | None = None
        self._breathe: Callable[[], None] = lambda: None

    def follow(self, asked: Asked, shaper: str = "") -> None:
        """Judge by this from now on; takes a second, so not on the loop's thread in flight.

        Args:
            asked: Of uplink and downlink.
            shaper: Of what this end sends: "relay" or "netem"; "" if that is not known.
        """
        if asked == self._asked and self._basis is not None:
            self._basis.by_netem = shaper == "netem"
            return
        own, other = asked if self._uplink else reversed(asked)
        basis = Basis(own, other if self._uplink else None, self._stream, self._breathe)
        basis.by_netem = shaper == "netem"
        self._asked, self._basis = asked, basis
        self._tally.place = basis.place
        self._quiet_ns = -1  # set anew by the loop's thread

    def rest(self) -> None:
        """Judge no more until it is known again by what."""
        self._basis = None

    def begin(self, asked: Asked, path: Path | None, load: Load) -> None:
        """Work out on a daemon thread what to judge by.

        Args:
            asked: Of uplink and downlink, until the link itself tells.
            path: State file of the link, which is followed; None if there is none.
            load: Reads the profile in it.
        """
        jobs: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._jobs, self._breathe = jobs, _breathe
        threading.Thread(
            target=_follow, args=(self, asked, path, load, jobs), name="link check", daemon=True
        ).start()

    def after(self, records: Iterable[Record], now_ns: int) -> list[Record]:
        """Take in what this end has just recorded; say every 5 s what to think of the link.

        Args:
            records: Oldest first.
            now_ns: This end's clock [ns].
        """
        held = self._held
        held += records
        if now_ns < self._sum_ns:
            return []
        self._sum_ns = now_ns + SUM_PERIOD_NS
        if self._quiet_ns < 0:
            self._begin(now_ns)
        for record in held:
            if isinstance(record, Arrival):
                if self._tally.see(record):
                    self._begin(now_ns)
            elif isinstance(record, Lateness):
                self._tally.block.wakes += 1
                late = record.lateness + record.busy
                self._tally.block.lateness += late
                self._tally.block.late_squares += late * late
                self._tally.block.late_cubes += late * late * late
            elif isinstance(record, Control) and self._uplink:
                self._see_trip(record)
        held.clear()
        if now_ns < self._quiet_ns:
            self._tally.forget()
            return []
        return [*self._judge(now_ns), *self._failed(now_ns)] if now_ns >= self._due_ns else []

    def _begin(self, now_ns: int) -> None:
        self._blocks.clear()
        self._tally.forget()
        self._quiet_ns = self._since_ns = now_ns + SETTLE_NS
        self._due_ns = self._quiet_ns + PERIOD_NS
        self._settled = False
        if (basis := self._basis) is not None:
            basis.forget()

    def _see_trip(self, record: Control) -> None:
        trip = record.rtt
        if not isnan(trip) and trip != self._trip:  # a new echo
            self._trip = trip
            self._tally.block.trips += trip
            self._tally.block.trip_count += 1

    def _judge(self, now_ns: int) -> list[Record]:
        self._due_ns = now_ns + PERIOD_NS
        basis, tally = self._basis, self._tally
        if basis is None:
            return []
        self._blocks.append(tally.take())
        changing = now_ns < self._since_ns + basis.changing_ns
        if basis.worth(changing):
            self._compare(basis)
        if not changing and not self._settled:
            self._settled = True
            if basis.changing_ns:  # sums over what has changed say nothing
                self._blocks.clear()
                return []
        rows, count = self._judged(basis, changing)
        if not count:
            return []
        checked: list[Record] = [_record(row, now_ns, self._uplink, count) for row in rows]
        return checked + self._complain(rows, now_ns)

    def _judged(self, basis: Basis, changing: bool) -> Judged:
        """Sum up what is judged together, newest first, and forget what is older."""
        whole, recent, blocks = Block(), Block(), self._blocks
        window = basis.window(timed=any(block.timed for block in blocks))
        for block in reversed(list(blocks)):
            if whole.sent >= window:
                blocks.popleft()
                continue
            whole.add(block)
            if recent.sent < RECENT:
                recent.add(block)
        return basis.judge_changing(whole) if changing else basis.judge(whole, recent)

    def _compare(self, basis: Basis) -> None:
        """Let single datagrams be compared: on a thread of its own, if there is one."""
        tally = self._tally
        job = partial(basis.compare, tally.epoch, list(tally.heard))
        if self._jobs is None:
            job()
        elif self._jobs.empty():
            self._jobs.put(job)

    def _complain(self, rows: list[Row], now_ns: int) -> list[Record]:
        """Say once that the link is not what was asked for."""
        before, self._said = self._said, verdict_of(rows)
        if self._said != "off" or before == "off":
            return []
        way = "uplink" if self._uplink else "downlink"
        wrong = ", ".join(_in_words(row) for row in rows if row.verdict == "off")
        text = f"the {way} is not what was asked for: {wrong}; see 'cloudrc link verify'"
        return [Fault(now_ns, "link", text)]

    def fail(self, error: Exception) -> None:
        """Have it told that single datagrams could not be compared."""
        self._failure = (
            f"the standing check of the link failed ({describe_error(error)}); it goes on"
        )

    def _failed(self, now_ns: int) -> list[Record]:
        text, self._failure = self._failure, ""
        return [Fault(now_ns, "link_check", text)] if text else []


def _follow(
    check: StandingCheck,
    asked: Asked,
    path: Path | None,
    load: Load,
    jobs: queue.SimpleQueue[Callable[[], None]],
) -> None:
    """Begin with what is asked; for ever do what is to do, and look whether the profile changes."""
    check.follow(asked)
    seen, failed = "", False
    while True:
        try:
            text = read(path, STATE_MAX).decode() if path is not None else seen
            if text != seen:
                seen = text
                state = from_text(text)
                check.follow(load(state.profile), state.shaper)
        except TooLongError:  # a long time line: what was asked before holds no more
            seen = ""
            check.rest()
        except Exception:  # not there yet, half written or nonsense: what was asked still holds
            pass
        try:
            jobs.get(timeout=LOOK_PERIOD)()
        except queue.Empty:
            pass
        except Exception as error:  # statistics go on judging, and the next job may do better
            if not failed:
                failed = True
                check.fail(error)


def _breathe() -> None:
    """Let the loop's thread run: it waits for the interpreter, which a long look would hold."""
    time.sleep(1e-4)


def _record(row: Row, now_ns: int, uplink: bool, count: int) -> LinkChecked:
    name, _, asked, _, measured, low, high, verdict = row
    return LinkChecked(now_ns, uplink, name, asked, measured, low, high, verdict, count)


def _in_words(row: Row) -> str:
    scale, unit = (1e2, "%") if row.unit == "1" else (1e3, "ms")
    return f"{row.name} {row.measured * scale:.1f} {unit} instead of {row.asked * scale:.1f}"
