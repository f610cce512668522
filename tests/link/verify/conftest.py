"""Flights that the standing check hears, drawn without any flight: what an end notes of a link.

The kernel's netem in virtual time, as `sch_netem.c` draws: what our own model does not share.

Source: Linux, net/sched/sch_netem.c: get_crandom, tabledist, loss_gilb_ell, netem_enqueue.

Probes on a link of virtual time: what `cloudrc link verify` would see, without waiting.
"""

from __future__ import annotations

import random
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.errors import BadInputError
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import Conditions, DirectionProfile, GilbertElliott, Timeline
from cloudrc.link.tc import check, stretch, table
from cloudrc.link.verify.causes import Evidence, Findings
from cloudrc.link.verify.judge import SIZE, Row, Trains, judge, plan_trains, spans
from cloudrc.link.verify.measure import Log, measure
from cloudrc.link.verify.monitor import StandingCheck
from cloudrc.link.verify.plan import Plan, make_plan
from cloudrc.link.verify.reference import frame_of
from cloudrc.link.verify.twin import Stream
from cloudrc.records import Arrival, Fault, Lateness, LinkChecked, Record

_WORDS, _ONE = 1 << 32, 8192
_HEADERS = 28
_IN_ORDER = 100e9


class VirtualNetem:
    """Shapes one direction; asked like the model's `LinkDirection`, in the order of sending."""

    def __init__(self, profile: DirectionProfile, seed: int) -> None:
        check(profile)
        self._profile, self._timeline = profile, Timeline(profile)
        self._chance = random.Random(seed)
        self._rho = round(profile.correlation * (_WORDS - 1))
        self._last_draw = self._chance.getrandbits(32)
        self._bad = False
        self._last_ns = 0
        distribution = profile.distribution
        self._table = None if distribution == "table" else table(distribution)

    def send(self, epoch: int, kind: int, counter: int, size: int, now_ns: int) -> list[int]:
        """Give the instants at which copies of a packet arrive [ns]."""
        now = self._timeline.at(now_ns)
        return [at_ns for at_ns in self._enqueue(now, size, now_ns, copies=True) if at_ns >= 0]

    def _enqueue(self, now: Conditions, size: int, now_ns: int, copies: bool) -> list[int]:
        profile, count, found = self._profile, 1, list[int]()
        if copies and self._chance.random() < profile.duplicate:
            count += 1
        if self._loses(now):
            count -= 1
        if count == 0:
            return []
        if count > 1:  # the copy goes through all of it once more
            found += self._enqueue(now, size, now_ns, copies=False)
        damaged = self._chance.random() < profile.corrupt
        if profile.reorder and not profile.keep_order and self._chance.random() < profile.reorder:
            return [*found, -1 if damaged else now_ns]
        at_ns = now_ns + self._delay_ns(now)
        rate = now.rate or (_IN_ORDER if profile.keep_order else None)
        if rate is not None:
            at_ns = max(at_ns, now_ns, self._last_ns) + round((size + _HEADERS) * 8e9 / rate)
            self._last_ns = at_ns
        return [*found, -1 if damaged else max(now_ns, at_ns)]

    def _loses(self, now: Conditions) -> bool:
        loss = 1.0 if now.blackout else now.loss
        if not isinstance(loss, GilbertElliott):
            return self._chance.random() < loss
        share = loss.loss_bad if self._bad else loss.loss_good
        if self._chance.random() < (loss.bad_end if self._bad else loss.bad_start):
            self._bad = not self._bad
        return self._chance.random() < share

    def _delay_ns(self, now: Conditions) -> int:
        if not now.jitter:
            return now.delay_ns
        drawn = self._draw()
        assert self._table is not None
        sigma = now.jitter * stretch(self._profile) * 1e9
        return round(now.delay_ns + sigma * self._table[drawn % len(self._table)] / _ONE)

    def _draw(self) -> int:
        """Draw a number whose first bits alone resemble those of the number before."""
        drawn = self._chance.getrandbits(32)
        if self._rho:
            rho = self._rho + 1
            drawn = (drawn * (_WORDS - rho) + self._last_draw * rho) >> 32
            self._last_draw = drawn
        return drawn


def can(profile: DirectionProfile) -> bool:
    """Whether netem can do it at all."""
    try:
        check(profile)
    except BadInputError:
        return False
    return True


PERIOD_NS = 10_000_000
COMMAND, STANDING_SIZE = 4, 88
TELEMETRY, TELEMETRY_SIZE = 3, 203
PAPER = link_profile(load_profile("paper-p2").downlink)
P1 = link_profile(load_profile("paper-p1").downlink)
LOSSY = link_profile(load_profile("lossy").downlink)
SATELLITE = link_profile(load_profile("satellite").downlink)
HANDOVER = link_profile(load_profile("handover").downlink)
ZERO = (0.0, 0.0, 0.0)
DRAWS = Stream(1, False, COMMAND, STANDING_SIZE)
"""Seed 1 is the experiment's; links of another seed draw otherwise, as netem does."""


def arrivals(
    profile: DirectionProfile,
    seconds: float = 60.0,
    *,
    seed: int = 1,
    overhead: float = 5e-4,
    uplink: bool = False,
    netem: bool = False,
) -> list[Arrival]:
    """What an end notes of a minute of datagrams over a link.

    Args:
        profile: Of the link.
        seconds: How long [s].
        seed: Of its chance.
        overhead: What the ends add [s]; NaN: they share no clock.
        uplink: Whether cloud hears telemetry; else world hears commands.
        netem: Whether netem shapes, which draws as the kernel does.
    """
    model = LinkDirection(profile, seed, uplink=uplink)
    link = VirtualNetem(profile, seed) if netem else model
    kind, size = (TELEMETRY, TELEMETRY_SIZE) if uplink else (COMMAND, STANDING_SIZE)
    found, whole = [], bytes(size)
    for n in range(round(seconds * 100)):
        sent_ns = n * PERIOD_NS
        fate = link.send(1, kind, n, size, sent_ns)
        if link is model and model.corrupts and model.corrupted(1, kind, n, whole) != whole:
            continue  # its tag does not fit: refused
        for at_ns in fate:
            delay = (at_ns - sent_ns) * 1e-9 + overhead
            found.append(Arrival(at_ns, uplink, 1, n, delay, True))
    return sorted(found)


def checked(
    check: StandingCheck, records: Iterable[Record], since_ns: int = 0
) -> tuple[list[LinkChecked], list[Fault]]:
    """Hand over records one by one, as a loop does."""
    said: list[Record] = []
    for record in records:
        said += check.after([record], record.stamp_ns + since_ns)
    return (
        [one for one in said if isinstance(one, LinkChecked)],
        [one for one in said if isinstance(one, Fault)],
    )


def downlink(asked: DirectionProfile) -> StandingCheck:
    return hearing(asked, uplink=False)


def punctual(arrivals: Iterable[Arrival], late: float = 1e-4, busy: float = 1e-4) -> list[Record]:
    """Add what an end tells of its wakes, one per arrival: how late, and how long busy [s]."""
    heard: list[Record] = []
    for arrival in arrivals:
        heard += [arrival, Lateness(arrival.stamp_ns, "cloud", late, busy, 0)]
    return heard


def hearing(asked: DirectionProfile, uplink: bool) -> StandingCheck:
    """The check of the end that hears this direction."""
    draws = Stream(1, True, TELEMETRY, TELEMETRY_SIZE) if uplink else DRAWS
    check = StandingCheck(uplink=uplink, stream=draws)
    check.follow((asked, asked))
    return check


def newest(records: list[LinkChecked]) -> dict[str, LinkChecked]:
    last = max((record.stamp_ns for record in records), default=0)
    return {record.quantity: record for record in records if record.stamp_ns == last}


def believed(records: list[LinkChecked]) -> bool:
    """Whether the newest verdict is that all is as asked."""
    return {record.verdict for record in newest(records).values()} - {"told"} == {"ok"}


def moments(records: list[LinkChecked]) -> list[list[LinkChecked]]:
    """The verdicts, one after the other."""
    stamps = sorted({record.stamp_ns for record in records})
    return [[one for one in records if one.stamp_ns == stamp] for stamp in stamps]


PROBE, TRAIN = 9, 10
PROBE_SIZE = 200
OVERHEAD_NS = 80_000
"""What a good relay and the stack add [ns]."""


@dataclass
class Asked:
    """A direction to be verified, and how."""

    profile: DirectionProfile
    plan: Plan
    trains: Trains | None

    @classmethod
    def of(cls, profile: DirectionProfile, seconds: float | None = None) -> Asked:
        plan = make_plan(profile, PROBE_SIZE, seconds)
        return cls(profile, plan, plan_trains(profile, plan.duration + 1.0))


def probe(
    asked: Asked,
    applied: DirectionProfile,
    seed: int = 1,
    *,
    stall: float = 0.0,
    evidence: Evidence | None = None,
    overhead_ns: int = OVERHEAD_NS,
    link: VirtualNetem | None = None,
) -> Findings:
    """Send what was planned over a link of `applied`; a stalled relay holds 30 % of it up [s]."""
    rng = np.random.default_rng(seed)
    direction = link or LinkDirection(applied, seed, True)
    schedule = asked.plan.schedule
    first_ns, period_ns = round(schedule.begin * 1e9), round(schedule.period * 1e9)
    log = Log([first_ns + n * period_ns for n in range(schedule.count)])
    log.arrivals = flow(direction, PROBE, log.sent_ns, schedule.size)
    damaged = {number for number, _ in log.arrivals if is_damaged(direction, PROBE, number)}
    log.arrivals = [
        (number, at_ns + overhead_ns + round(stall * 1e9 * rng.random()) * (rng.random() < 0.3))
        for number, at_ns in log.arrivals
    ]
    drawn_out = []
    if asked.trains is not None:
        trains, begin_ns = asked.trains, log.sent_ns[-1] + 1_000_000_000
        sent_ns = [
            begin_ns + round(train * trains.period * 1e9) + k * 20_000
            for train in range(trains.count)
            for k in range(trains.length)
        ]
        arrivals = flow(direction, TRAIN, sent_ns, SIZE)
        drawn_out = spans(trains.count, trains.length, arrivals)
    sent = np.array(log.sent_ns) * 1e-9
    frame = frame_of(asked.profile, sent)
    measured = measure(log, asked.plan.expects.over_time, drawn_out, frame, len(damaged))
    evidence = evidence or Evidence("relay", applied=applied, layers=1, late=2e-4)
    rows: list[Row] = judge(asked.plan, measured, asked.trains, evidence.applied)
    return Findings(rows, evidence)


def flow(
    direction: LinkDirection | VirtualNetem, kind: int, sent_ns: list[int], size: int
) -> list[tuple[int, int]]:
    """Put datagrams on a link: number and instant of each arrival."""
    return [
        (number, at_ns)
        for number, stamp_ns in enumerate(sent_ns)
        for at_ns in direction.send(1, kind, number, size, stamp_ns)
    ]


def is_damaged(direction: LinkDirection | VirtualNetem, kind: int, number: int) -> bool:
    """Whether a datagram that arrives is not as it was sent."""
    whole = bytes(PROBE_SIZE)
    if isinstance(direction, VirtualNetem):
        return False  # that never arrives
    return direction.corrupts and direction.corrupted(1, kind, number, whole) != whole


def random_profile(rng: np.random.Generator) -> DirectionProfile:
    """Draw a link that somebody might ask for."""
    delay = float(rng.uniform(5e-3, 0.15))
    profile = DirectionProfile(
        delay,
        min(0.03, float(rng.uniform(0.0, 0.4)) * delay),
        str(rng.choice(["uniform", "normal", "pareto"])),  # type: ignore[arg-type]
    )
    if rng.random() < 0.3:
        profile = replace(profile, correlation=float(rng.uniform(0.1, 0.6)))
    if rng.random() < 0.3:
        # In order, one slow packet holds up all that follow: minutes would be needed.
        profile = replace(profile, keep_order=True, jitter=min(0.01, profile.jitter))
    elif rng.random() < 0.3:
        profile = replace(profile, reorder=float(rng.uniform(0.01, 0.3)))
    if rng.random() < 0.2:
        profile = replace(profile, duplicate=float(rng.uniform(0.01, 0.1)))
    if rng.random() < 0.2:
        profile = replace(profile, corrupt=float(rng.uniform(0.001, 0.2)))
    if rng.random() < 0.2:
        rate = float(rng.uniform(1e6, 2e7))
        return replace(profile, rate=rate, keep_order=True, jitter=min(0.01, profile.jitter))
    if rng.random() < 0.3:
        bursts = GilbertElliott(float(rng.uniform(1e-3, 0.01)), float(rng.uniform(0.2, 0.6)))
        return replace(profile, loss=bursts)
    if rng.random() < 0.6:
        return replace(profile, loss=float(rng.uniform(0.0, 0.1)))
    return profile
