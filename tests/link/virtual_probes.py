"""Probes on a link of virtual time: what `cloudrc link verify` would see, without waiting."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from virtual_netem import VirtualNetem

from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile, GilbertElliott
from cloudrc.link.verify.causes import Evidence, Findings
from cloudrc.link.verify.judge import SIZE, Row, Trains, judge, plan_trains, spans
from cloudrc.link.verify.measure import Log, measure
from cloudrc.link.verify.plan import Plan, make_plan
from cloudrc.link.verify.reference import frame_of

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
