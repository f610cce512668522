"""Faults F6, F7 and F9 to F12: disorder, copies, clocks, steps of the delay, asymmetry, jitter."""

from __future__ import annotations

from dataclasses import replace
from math import isnan

from cloudrc.faults import measures
from cloudrc.faults.flight import Flight, Shape
from cloudrc.faults.models import Clock
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.link.profile import Change
from cloudrc.records import Arrival, Control

HOUR_NS = 3_600_000_000_000
AGE = "command_age_seconds"
"""Metric of the age of the command in use, on world's clock."""


def _disorder(seed: int) -> Outcome:
    outcome = Outcome()
    shape: Shape = lambda profile: replace(  # noqa: E731
        profile, delay=0.05, jitter=0.0, reorder=0.25
    )
    flight = Flight(seed=seed, uplink=shape, downlink=shape).fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.true("commands applied in order, none twice", measures.applied_in_order(flight))
    for name, labels in (("datagrams_reordered_total", ()), ("datagrams_total", ("late",))):
        measures.moves(outcome, flight, "world", name, "downlink", *labels, since=0.0)
    outcome.least("late commands dropped", flight.count("late"), 100)
    return outcome


def _copies(seed: int) -> Outcome:
    outcome = Outcome()
    steady: Shape = lambda profile: replace(profile, jitter=0.0)  # noqa: E731
    twice: Shape = lambda profile: replace(profile, jitter=0.0, duplicate=1.0)  # noqa: E731
    clean = Flight(seed=seed, uplink=steady, downlink=steady).fly_mission()
    flight = Flight(seed=seed, uplink=twice, downlink=twice).fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.true("the same path, bit by bit", measures.same_path(clean, flight))
    measures.moves(outcome, flight, "world", "datagrams_total", "downlink", "repeated", since=0.0)
    outcome.least("copies dropped", flight.count("repeated"), 1000)
    return outcome


def _clocks(seed: int) -> Outcome:
    outcome = Outcome()
    clean = Flight(seed=seed).fly_mission()
    for hours in (-1, 1):
        apart = Flight(seed=seed, cloud_clock=Clock((48 + hours) * HOUR_NS)).fly_mission()
        text = f"cloud's clock {48 + hours} h ahead: the same path, bit by bit"
        outcome.true(text, measures.same_path(clean, apart))
    for ppm in (-500, 500):
        drifting = Flight(seed=seed, cloud_clock=Clock(HOUR_NS, ppm)).fly_mission()
        measures.safe_and_done(outcome, drifting)
        outcome.same(f"drift of {ppm} ppm: HOLDs", len(measures.held(drifting)), 0)
    return outcome


def _delay_step(seed: int) -> Outcome:
    """Step the delay; a jitter of 1 ms makes the round trips differ, as the metric needs."""
    outcome, at = Outcome(), measures.instant(seed)
    shape: Shape = lambda profile: replace(  # noqa: E731
        profile, delay=0.01, jitter=0.001, changes=(Change(at, delay=0.1),)
    )
    flight = Flight("cloud.estimator=split", seed=seed, uplink=shape, downlink=shape).fly_mission()
    measures.safe_and_done(outcome, flight)
    late = [
        abs(r.horizon - r.loop_delay) / r.loop_delay
        for r in flight.of_cloud
        if isinstance(r, Control) and at + 0.5 <= r.stamp_ns * 1e-9 < at + 2.0
    ]
    outcome.most("delay estimate off after 0.5 s, share", max(late, default=float("nan")), 0.2)
    outcome.same("HOLDs", len(measures.held(flight)), 0)
    measures.moves(outcome, flight, "cloud", "delay_estimate_seconds", since=at)
    before, after = (
        measures.seen_by(flight, "cloud", at + later) for later in (0.0, measures.SOON)
    )
    shown = measures.reading("cloud", after, "delay_estimate_seconds")
    outcome.least("metric delay_estimate_seconds", shown, 0.15, "s")
    long, longer = (
        measures.above("cloud", seen, "rtt_seconds", 0.15)[0] for seen in (before, after)
    )
    outcome.same("metric rtt_seconds: round trips above 0.15 s before the step", long, 0)
    outcome.least("metric rtt_seconds: round trips above 0.15 s within 5 s of it", longer, 200)
    return outcome


def _asymmetry(seed: int) -> Outcome:
    outcome = Outcome()
    flight = Flight(
        "link.profile=ideal",
        "link.uplink.delay_ms=10",
        "link.downlink.delay_ms=190",
        seed=seed,
        cloud_clock=Clock(offset_ns=HOUR_NS),
    ).fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.same("HOLDs", len(measures.held(flight)), 0)
    rtt = measures.reading("cloud", flight.of_cloud, "rtt_seconds")
    outcome.most("metric rtt_seconds, its mean is off 0.2 s by", abs(rtt - 0.2), 0.01, "s")
    arrivals = [r for r in (*flight.of_world, *flight.of_cloud) if isinstance(r, Arrival)]
    outcome.true("no one-way delay is claimed", all(isnan(r.delay) for r in arrivals))
    return outcome


def _jitter(seed: int) -> Outcome:
    outcome = Outcome()
    steady: Shape = lambda profile: replace(profile, jitter=0.0)  # noqa: E731
    wild: Shape = lambda profile: replace(profile, delay=0.15, jitter=0.15)  # noqa: E731
    without = Flight("link.profile=paper-p3", seed=seed, uplink=steady, downlink=steady)
    flight = Flight("link.profile=paper-p3", seed=seed).fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.same("jitter 40 ms: HOLDs", len(measures.held(flight)), 0)
    young, old = _ages(without.fly_mission())
    outcome.most(f"without jitter: metric {AGE}: outside 0.1 to 0.15 s", young + old, 0.01)
    young, old = _ages(flight)
    outcome.least(f"jitter 40 ms: metric {AGE}: share that is at most 0.1 s", young, 0.05)
    outcome.least(f"jitter 40 ms: metric {AGE}: share above 0.15 s", old, 0.05)
    flight = Flight(seed=seed, uplink=wild, downlink=wild).fly(60.0)
    measures.safe(outcome, flight)
    measures.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=0.0)
    _, old = _ages(flight)
    outcome.least(f"jitter 150 ms: metric {AGE}: share above 0.15 s", old, 0.25)
    _, old = measures.above("world", flight.of_world, AGE, 0.25)
    outcome.same(f"jitter 150 ms: metric {AGE}: share above 0.25 s", old, 0.0)
    outcome.most(
        "jitter 150 ms: changes of the guard in any second",
        measures.busiest_second(flight.changes),
        2,
    )
    return outcome


def _ages(flight: Flight) -> tuple[float, float]:
    """Return the shares of commands [1] that were at most 0.1 s old, and above 0.15 s."""
    older = [measures.above("world", flight.of_world, AGE, each)[1] for each in (0.1, 0.15)]
    return 1.0 - older[0], older[1]


SCENARIOS = (
    Scenario(
        6,
        "reordering",
        "25 % of the datagrams overtake the others by 50 ms",
        "late commands are dropped, never applied",
        "the late ones",
        "cloudrc_datagrams_total{outcome=late}, cloudrc_datagrams_reordered_total",
        _disorder,
    ),
    Scenario(
        7,
        "duplication",
        "every datagram arrives twice, on a link without jitter: no copy comes first",
        "the same path, bit by bit",
        "none",
        "cloudrc_datagrams_total{outcome=repeated}",
        _copies,
    ),
    Scenario(
        9,
        "clock-steps",
        "the clocks of the two ends lie two days and an hour apart; one drifts by 500 ppm",
        "the same flight, bit by bit; drift is flown in TRACK",
        "none",
        "nothing: no metric (a step of the wall clock: fault 'wall_clock')",
        _clocks,
    ),
    Scenario(
        10,
        "delay-step",
        "the round trip steps from 20 to 200 ms",
        "estimator `split` within 20 % in 0.5 s; no HOLD; the caps hold",
        "none",
        "cloudrc_rtt_seconds, cloudrc_delay_estimate_seconds",
        _delay_step,
    ),
    Scenario(
        11,
        "asymmetric-delay",
        "10 ms up, 190 ms down, two clocks an hour apart",
        "ages use the round trip: flown in TRACK; no one-way delay is claimed",
        "none",
        "cloudrc_rtt_seconds; one-way delays are absent",
        _asymmetry,
    ),
    Scenario(
        12,
        "jitter",
        "jitter of 40 ms, then of 150 ms about 150 ms",
        "first TRACK, then HOLD and TRACK without chatter: <= 2 changes in any second",
        "none",
        "cloudrc_command_age_seconds, cloudrc_guard_transitions_total",
        _jitter,
    ),
)
