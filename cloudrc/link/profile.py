# SPDX-License-Identifier: Apache-2.0

"""Define the keys of a link profile, and compute the conditions of a direction over time from them.

The classes of the keys are plain; the models in `config/profile.py` inherit keys, ranges and texts
from them. All delays are ONE WAY. `link/profile_file.py`, `config` and `link/traces.py` check the
values; this module does not.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from math import inf
from typing import Annotated, Final, Literal, NamedTuple

from cloudrc.base.outside.values import Quantity

NotNegative = Annotated[float, Quantity(ge=0)]
Positive = Annotated[float, Quantity(gt=0)]
Probability = Annotated[float, Quantity(ge=0, le=1)]
COMMAND_AGE_MS = 1, 10_000
"""Smallest and largest value of guard.command_age_max_ms [ms]."""
CommandAge = Annotated[float, Quantity(ge=COMMAND_AGE_MS[0], le=COMMAND_AGE_MS[1])]
CLOUD_TIME_MAX = 10
"""Largest value of cloud.horizon_max_s and of cloud.freeze_after_s [s]."""
CloudTime = Annotated[float, Quantity(gt=0, le=CLOUD_TIME_MAX)]
DIRECTIONS = ("uplink", "downlink")
RANDOM: Final = "random"
"""Start of a schedule that is drawn from seed, episode and stream."""
Start = NotNegative | Literal["random"]
"""Where a schedule begins: a time [s], or `RANDOM`."""


PHASE_PACKETS = 10
"""Number of packets that a simulation sends at each of many random phases of a radio."""
PERIOD_KEYS = ("repeat_s", "trace", "rate_trace")
"""Keys of a direction that give its schedule a period."""


@dataclass(frozen=True)
class GilbertElliott:
    """Loss in bursts: a two-state Markov chain that takes one step per packet."""

    bad_start: Probability
    """Chance per packet that the good state turns bad; 0: no burst begins"""
    bad_end: Probability
    """Chance per packet that the bad state turns good; a burst has 1 / bad_end packets on average.
    Must be above 0 if bad_start is above 0"""
    loss_bad: Probability = 1.0
    """Chance that a packet is lost in the bad state"""
    loss_good: Probability = 0.0
    """Chance that a packet is lost in the good state"""
    delay_bad_ms: NotNegative = 0.0
    """Extra one-way delay in the bad state [ms]; netem refuses a value above 0"""

    def conflict(self) -> str:
        """Say which keys do not agree with each other; "" if all do."""
        if self.bad_start > 0 and self.bad_end == 0:
            return "bad_end must be above 0 if bad_start is: else a burst never ends"
        return ""


Loss = Probability | GilbertElliott


@dataclass(frozen=True)
class Blackout:
    """An interval in which every packet is lost."""

    start_s: NotNegative
    """Start, in time since the link came up [s]"""
    duration_s: Positive
    """Length [s]"""


@dataclass(frozen=True)
class Radio:
    """A radio that schedules: it has slots for one direction at a time, and grants them.

    What is not modelled: fading, the load of others, handover, sleep (DRX), order of the RLC layer.
    """

    slot_ms: Annotated[float, Quantity(ge=0.001)] = 0.5
    """Length of a slot [ms]"""
    tdd: str = "DDDSU"
    """Pattern of the slots: D downlink, U uplink, S carries nothing. An uplink packet takes the
    first U of a pattern, a downlink packet any D"""
    request_ms: NotNegative = 10.0
    """Time between two slots in which a packet of the uplink may ask for a grant [ms], a multiple
    of the pattern; 0: a configured grant, for which nobody asks. Downlink: no effect"""
    grant_ms: NotNegative = 2.0
    """Time from the end of a request to the grant [ms]. Downlink: no effect"""
    error: Annotated[float, Quantity(ge=0, le=0.99)] = 0.1
    """Chance that a block fails, and is sent again"""
    repeat_ms: NotNegative = 5.0
    """Time that each repetition adds [ms]"""
    phase_ms: Start = 0.0
    """Time of the radio when the schedule of the link is at 0 [ms], or random: drawn from seed,
    stream, direction and episode"""
    drift_ppm: Annotated[float, Quantity(ge=-1e5, le=1e5)] = 0.0
    """How much faster the clock of the radio is than that of the sender [1e-6]"""

    @property
    def pattern_ns(self) -> int:
        """Length of the pattern [ns]."""
        return len(self.tdd) * round(self.slot_ms * 1e6)

    def conflict(self) -> str:
        """Say which keys do not agree with each other; "" if all do."""
        if not {"D", "U"} <= {*self.tdd} <= {*"DSU"}:
            return f"tdd: {self.tdd!r:.60}: give letters D, S and U, with at least one D and one U"
        if round(self.request_ms * 1e6) % self.pattern_ns:
            pattern = f"{self.pattern_ns * 1e-6:g} ms of the pattern {self.tdd}"
            return f"request_ms: {self.request_ms:g} ms is no multiple of the {pattern}"
        return ""


@dataclass(frozen=True)
class Change:
    """A change of one direction of the link; a key that is not given keeps its value."""

    at_s: NotNegative
    """Start, in time since the link came up [s]"""
    delay_ms: NotNegative | None = None
    """New mean one-way delay [ms]; null: unchanged"""
    jitter_ms: NotNegative | None = None
    """New jitter [ms]; null: unchanged"""
    loss: Loss | None = None
    """New loss; null: unchanged"""
    rate_kbit: Positive | None = None
    """New rate of the bottleneck [kbit/s]; null: unchanged"""


@dataclass(frozen=True)
class DirectionKeys:
    """Network conditions of one direction. All delays are ONE WAY."""

    delay_ms: NotNegative = 0.0
    """Mean one-way delay [ms]; a round trip is the sum of both directions"""
    jitter_ms: NotNegative = 0.0
    """Spread of the delay [ms]. For the distribution uniform it is half the width, for the others
    the standard deviation. A delay below 0 becomes 0, which raises the mean"""
    distribution: Literal["uniform", "normal", "pareto", "table"] = "uniform"
    """Distribution of the jitter; pareto has a long tail; table: the delays in the file `table`"""
    table: str | None = None
    """CSV file in the format of `trace`. Its delays, shifted to mean 0 and scaled to `jitter_ms`,
    are the distribution. Needed with distribution: table"""
    correlation: Probability = 0.0
    """Correlation between the jitter of a packet and of the next packet"""
    loss: Loss = 0.0
    """Chance that a packet is lost, or a mapping for loss in bursts"""
    duplicate: Probability = 0.0
    """Chance that a packet arrives twice; the copy has its own delay"""
    reorder: Probability = 0.0
    """Chance that a packet has no delay and so overtakes earlier packets; no effect with
    keep_order"""
    corrupt: Probability = 0.0
    """Chance that one bit of a packet is flipped; the receiver refuses such a packet"""
    keep_order: bool = False
    """Whether packets arrive in the order of sending, as from a queue"""
    rate_kbit: Positive | None = None
    """Rate of the bottleneck [kbit/s]; each packet counts with 28 bytes of headers;
    null: no bottleneck"""
    queue_packets: Annotated[int, Quantity(ge=1, le=1_000_000, whole=True)] = 1000
    """Largest number of packets in the queue of the bottleneck; further packets are dropped"""
    rate_trace: str | None = None
    """File with the opportunities of a bottleneck, as mahimahi records them: a line per 1500 bytes
    that may leave, its time in ms. It takes the place of rate_kbit; netem refuses it"""
    radio: Radio | None = field(default=None, repr=False)
    """A radio with slots and grants, before the delay: delay_ms is the way behind it. netem refuses
    it; null: none"""
    changes: tuple[Change, ...] = ()
    """Changes of the conditions over time; at_s must rise from entry to entry"""
    trace: str | None = None
    """CSV file with the columns time_s,delay_ms[,loss], which replace the keys delay_ms and loss. A
    relative path starts at the folder of the file that contains this key"""
    loop: bool = False
    """Whether trace, changes and blackouts begin again after a period; netem refuses true"""
    repeat_s: Positive | None = None
    """Period of the schedule [s], with loop and with start_s: random; null: that of the trace"""
    blackouts: tuple[Blackout, ...] = ()
    """Intervals in which every packet is lost; they may overlap"""

    def conflict(self) -> str:
        """Say which keys do not agree with each other; "" if all do."""
        if self.distribution == "table" and self.table is None:
            return "distribution: table needs the key table: a CSV file of delays"
        for before, after in pairwise(self.changes):
            if after.at_s <= before.at_s:
                return f"at_s of changes must rise: {after.at_s:g} s is after {before.at_s:g} s"
        if self.rate_trace and (self.rate_kbit or any(one.rate_kbit for one in self.changes)):
            return "rate_kbit and rate_trace are both a rate; leave one of them out"
        if self.loop and not self.may_repeat:
            return f"loop: {NO_PERIOD}"
        ends = [change.at_s for change in self.changes]
        ends += [one.start_s + one.duration_s for one in self.blackouts]
        return refuse_period(self.repeat_s, max(ends, default=0.0))

    @property
    def may_repeat(self) -> bool:
        """Whether a key gives the schedule a period."""
        return any(getattr(self, key) for key in PERIOD_KEYS)


@dataclass(frozen=True)
class ProfileKeys:
    """A link profile, such as the files under link/profiles."""

    description: str = ""
    """One line about the profile, for lists"""
    uplink: DirectionKeys = DirectionKeys()
    """Conditions from world to cloud"""
    downlink: DirectionKeys = DirectionKeys()
    """Conditions from cloud to world"""
    start_s: Start | None = None
    """Where in the schedule of both directions an episode or flight begins [s], or random: then
    the schedule repeats. null: 0; of episodes random, if it has a period"""
    command_age_max_ms: CommandAge | None = None
    """Default of guard.command_age_max_ms with this profile [ms]; null: 250"""
    horizon_max_s: CloudTime | None = None
    """Default of cloud.horizon_max_s with this profile [s]; null: 1"""
    freeze_after_s: CloudTime | None = None
    """Default of cloud.freeze_after_s with this profile [s]; null: 0.4"""

    def conflict(self) -> str:
        """Say which keys do not agree with each other; "" if all do."""
        return refuse_start(self.start_s, self.uplink, self.downlink)


NO_PERIOD = "the schedule has no period; give repeat_s, its period in s"
"""Why a schedule cannot repeat."""


def refuse_start(start: Start | None, *ways: DirectionKeys) -> str:
    """Say why a schedule cannot begin at `start`; "" if it can."""
    if start == RANDOM and not any(way.may_repeat for way in ways):
        return f"start_s: random: {NO_PERIOD}"
    return ""


def refuse_period(period: float | None, last: float) -> str:
    """Say why a schedule whose last part is at `last` cannot have a period [s]; "" if it can."""
    if period is None or period >= last:
        return ""
    return f"repeat_s: {period:g} s ends before the last entry, at {last:g} s; give a longer time"


def mean_loss(loss: Loss) -> float:
    """Return the share of packets lost in the long run, in [0, 1]."""
    if not isinstance(loss, GilbertElliott):
        return loss
    bad = loss.bad_start / (loss.bad_start + loss.bad_end) if loss.bad_start else 0.0
    return bad * loss.loss_bad + (1.0 - bad) * loss.loss_good


def whole_share(loss: Loss, count: int) -> float:
    """Return the share of messages of `count` successive packets that lose none, in [0, 1]."""
    if not isinstance(loss, GilbertElliott):
        return (1.0 - loss) ** count
    start, end = loss.bad_start, loss.bad_end
    bad = start / (start + end) if start else 0.0
    good = 1.0 - bad
    for _ in range(count):
        good, bad = good * (1.0 - loss.loss_good), bad * (1.0 - loss.loss_bad)
        good, bad = good * (1.0 - start) + bad * end, good * start + bad * (1.0 - end)
    return good + bad


@dataclass(frozen=True, slots=True)
class Trace:
    """Measured conditions over time: each row applies until the time of the next row.

    The delays replace the profile's `delay_ms`; the profile's jitter is added to them. If the trace
    has losses, they replace the profile's `loss`. The first row also applies before its time.

    The last row applies forever. If the schedule repeats and gives no other period, the last
    row lasts as long as the other rows on average.
    """

    times: tuple[float, ...]  # since the link came up, strictly rising [s], shape (n,), n >= 1
    delays: tuple[float, ...]  # one-way delay of each row [s], shape (n,)
    losses: tuple[float, ...] | None = None  # loss of each row in [0, 1], shape (n,)

    @property
    def period(self) -> float | None:
        """Return the period with which the trace can loop [s]; None if it has only one row."""
        if len(self.times) < 2:
            return None
        return self.times[-1] + (self.times[-1] - self.times[0]) / (len(self.times) - 1)


@dataclass(frozen=True)
class DirectionProfile(DirectionKeys):
    """One direction of a link profile, with the contents of the files that it names.

    A negative sum of delay and jitter counts as 0. `keep_order` disables `reorder`. A packet that
    finds the bottleneck's queue full is dropped.
    """

    rows: Trace | None = None
    """Contents of the file `trace`; None without this file"""
    quantiles: tuple[float, ...] = ()
    """Delays in the file `table`, which are equally probable: mean 0, standard deviation 1, rising,
    shape (n,), in units of the jitter [1]"""
    opportunities: tuple[int, ...] = ()
    """Times in the file `rate_trace` at which packets may leave [ns], shape (n,); the last one is
    its period"""

    @property
    def period_ns(self) -> int | None:
        """Period of the schedule [ns]; None if it has none."""
        period = self.repeat_s
        if period is None and self.rows is not None:
            period = self.rows.period
        if period is None:
            return self.opportunities[-1] if self.opportunities else None
        return round(period * 1e9)

    @property
    def phase_packets(self) -> int:
        """Number of packets after which a simulation needs another phase of the radio."""
        is_random = self.radio is not None and self.radio.phase_ms == RANDOM
        return PHASE_PACKETS if is_random else 1 << 62


def going_round(profile: DirectionProfile) -> DirectionProfile:
    """Return a direction whose schedule begins again after its period, if it has one."""
    return profile if profile.period_ns is None else replace(profile, loop=True)


class Conditions(NamedTuple):
    """The constant conditions during one piece of a schedule."""

    delay_ns: int  # mean one-way delay [ns]
    jitter: float  # [s]
    loss: Loss
    rate: float | None  # [bit/s]
    blackout: bool


class LinkSchedule:
    """The conditions of one direction over time, from its changes, trace and blackouts.

    Attributes:
        pieces: The conditions in each piece of the schedule, constant within the piece. If the
            schedule loops, the pieces are those of one period.
        pass_ns: Start of each piece [ns], rising; 0 is the time at which the link came up.
        period_ns: Period of a looping schedule [ns]; None if the schedule does not loop.
    """

    def __init__(self, profile: DirectionProfile) -> None:
        self.pass_ns, self.pieces, self.period_ns = _lay_out(profile)

    def at(self, elapsed_ns: int) -> Conditions:
        """Return the conditions at the time `elapsed_ns` [ns] after the link came up."""
        if self.period_ns is not None and elapsed_ns > 0:
            elapsed_ns %= self.period_ns
        place = bisect_right(self.pass_ns, elapsed_ns)
        return self.pieces[place - 1 if place else 0]

    @property
    def last_ns(self) -> float:
        """Time from the start of the link to the last change [ns]; infinite if changes repeat."""
        return self.pass_ns[-1] if self.period_ns is None else inf

    def only(self) -> Conditions | None:
        """Return the conditions if they never change, otherwise None."""
        return self.pieces[0] if len(self.pieces) == 1 else None


def settled(profile: DirectionProfile) -> DirectionProfile:
    """Return the profile with constant conditions: those of the last piece of its schedule."""
    last = LinkSchedule(profile).pieces[-1]
    return replace(
        profile,
        delay_ms=last.delay_ns * 1e-6,
        jitter_ms=last.jitter * 1e3,
        loss=1.0 if last.blackout else last.loss,
        rate_kbit=None if last.rate is None else last.rate * 1e-3,
        changes=(),
        rows=None,
        blackouts=(),
        loop=False,
        repeat_s=None,
    )


@lru_cache(maxsize=8)  # of a few links; of a trace with millions of rows it takes long
def _lay_out(profile: DirectionProfile) -> tuple[list[int], list[Conditions], int | None]:
    """Return of a `LinkSchedule` `pass_ns`, `pieces`, `period_ns`; the lists stay as they are."""
    instants = {0.0, *(change.at_s for change in profile.changes)}
    instants.update(profile.rows.times if profile.rows else ())
    for blackout in profile.blackouts:
        instants.update((blackout.start_s, blackout.start_s + blackout.duration_s))
    period_ns = profile.period_ns if profile.loop else None
    end_ns = inf if period_ns is None else period_ns
    ordered = [instant for instant in sorted(instants) if round(instant * 1e9) < end_ns]
    pass_ns = [round(instant * 1e9) for instant in ordered]
    return pass_ns, list(_pieces(profile, ordered)), period_ns


def _pieces(profile: DirectionProfile, instants: Sequence[float]) -> Iterator[Conditions]:
    """Yield the conditions from each of the rising `instants` [s]; a trace may have millions."""
    always = None if profile.changes or profile.blackouts else _conditions(profile, 0.0)
    trace, row = profile.rows, 0
    for instant in instants:
        now = always or _conditions(profile, instant)
        if trace is None:
            yield now
            continue
        while row + 1 < len(trace.times) and trace.times[row + 1] <= instant:
            row += 1
        delay_ns = round(trace.delays[row] * 1e9)
        loss = now.loss if trace.losses is None else trace.losses[row]
        yield Conditions(delay_ns, now.jitter, loss, now.rate, now.blackout)


def _conditions(profile: DirectionProfile, instant: float) -> Conditions:
    """Return the conditions at an instant [s] without the trace."""
    delay, jitter, loss = profile.delay_ms * 1e-3, profile.jitter_ms, profile.loss
    rate = profile.rate_kbit
    for change in profile.changes:
        if change.at_s > instant:
            break
        delay = delay if change.delay_ms is None else change.delay_ms * 1e-3
        jitter = jitter if change.jitter_ms is None else change.jitter_ms
        loss = loss if change.loss is None else change.loss
        rate = rate if change.rate_kbit is None else change.rate_kbit
    blackout = any(b.start_s <= instant < b.start_s + b.duration_s for b in profile.blackouts)
    rate = None if rate is None else rate * 1e3
    return Conditions(round(delay * 1e9), jitter * 1e-3, loss, rate, blackout)


def summary(profile: DirectionProfile, radio: float = 0.0) -> dict[str, float | None]:
    """Summarise a direction's conditions at the start of its schedule.

    Returns:
        `delay` and `jitter` [s]; `loss`, the long-run share in [0, 1]; and `rate` [bit/s], which is
        None without a bottleneck. The delay includes `radio`, that in a radio [s].
    """
    first = LinkSchedule(profile).at(0)
    loss = 1.0 if first.blackout else mean_loss(first.loss)
    delay = round(first.delay_ns * 1e-9 + radio, 9)
    return {"delay": delay, "jitter": first.jitter, "loss": loss, "rate": first.rate}
