"""Faults F6, F7 and F9 to F12: disorder, copies, clocks, steps of the delay, asymmetry, jitter."""

from __future__ import annotations

from math import isnan, nan

from cloudrc.faults import measures
from cloudrc.faults.flight import Flight, conditions
from cloudrc.faults.models import Clock
from cloudrc.faults.scenario import Outcome, scenario
from cloudrc.link.profile import Change
from cloudrc.records import Arrival, Control

HOUR_NS = 3_600_000_000_000
AGE = "command_age_seconds"  # metric of the age of the command in use, on world's clock


@scenario(
    6,
    "reordering",
    injects="25 % of the datagrams overtake the others by 50 ms",
    expects="late commands are dropped, never applied",
    loses="the late ones",
    shows="cloudrc_datagrams_total{outcome=late}, cloudrc_datagrams_reordered_total",
)
def _disorder(outcome: Outcome, seed: int) -> None:
    shape = conditions(delay=0.05, jitter=0.0, reorder=0.25)
    flight = Flight(seed=seed, uplink=shape, downlink=shape).fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.true("commands applied in order, none twice", measures.applied_in_order(flight))
    measures.moves(outcome, flight, "world", "datagrams_reordered_total", "downlink", since=0.0)
    measures.moves(outcome, flight, "world", "datagrams_total", "downlink", "late", since=0.0)
    outcome.least("late commands dropped", flight.count("late"), 100)


@scenario(
    7,
    "duplication",
    injects="every datagram arrives twice, on a link without jitter: no copy comes first",
    expects="the same path, bit by bit",
    shows="cloudrc_datagrams_total{outcome=repeated}",
)
def _copies(outcome: Outcome, seed: int) -> None:
    steady, twice = conditions(jitter=0.0), conditions(jitter=0.0, duplicate=1.0)
    clean = Flight(seed=seed, uplink=steady, downlink=steady).fly_mission()
    flight = Flight(seed=seed, uplink=twice, downlink=twice).fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.true("the same path, bit by bit", measures.same_path(clean, flight))
    measures.moves(outcome, flight, "world", "datagrams_total", "downlink", "repeated", since=0.0)
    outcome.least("copies dropped", flight.count("repeated"), 1000)


@scenario(
    9,
    "clock-steps",
    injects="the clocks of the two ends lie two days and an hour apart; one drifts by 500 ppm",
    expects="the same flight, bit by bit; drift is flown in TRACK",
    shows="nothing: no metric (a step of the wall clock: fault 'wall_clock')",
)
def _clocks(outcome: Outcome, seed: int) -> None:
    clean = Flight(seed=seed).fly_mission()
    for hours in (47, 49):
        apart = Flight(seed=seed, cloud_clock=Clock(hours * HOUR_NS)).fly_mission()
        text = f"cloud's clock {hours} h ahead: the same path, bit by bit"
        outcome.true(text, measures.same_path(clean, apart))
    for ppm in (-500, 500):
        drifting = Flight(seed=seed, cloud_clock=Clock(HOUR_NS, ppm)).fly_mission()
        measures.safe_and_done(outcome, drifting)
        outcome.same(f"drift of {ppm} ppm: HOLDs", len(measures.held(drifting)), 0)


@scenario(
    10,
    "delay-step",
    injects="the round trip steps from 20 to 200 ms",
    expects="estimator `split` within 20 % in 0.5 s; no HOLD; the caps hold",
    shows="cloudrc_rtt_seconds, cloudrc_delay_estimate_seconds",
)
def _delay_step(outcome: Outcome, seed: int) -> None:
    """Step the delay; a jitter of 1 ms makes the round trips differ, as the metric needs."""
    at = measures.instant(seed)
    shape = conditions(delay=0.01, jitter=0.001, changes=(Change(at, delay=0.1),))
    flight = Flight("cloud.estimator=split", seed=seed, uplink=shape, downlink=shape).fly_mission()
    measures.safe_and_done(outcome, flight)
    off = [
        abs(r.horizon - r.loop_delay) / r.loop_delay
        for r in flight.of_cloud
        if isinstance(r, Control) and at + 0.5 <= r.stamp_ns * 1e-9 < at + 2.0
    ]
    outcome.most("delay estimate off after 0.5 s, share", max(off, default=nan), 0.2)
    outcome.same("HOLDs", len(measures.held(flight)), 0)
    soon, estimate = at + measures.SOON, "delay_estimate_seconds"
    measures.moves(outcome, flight, "cloud", estimate, since=at)
    shown = measures.reading(flight, "cloud", estimate, until=soon)
    outcome.least(f"metric {estimate}", shown, 0.15, "s")
    longer, _ = measures.above(flight, "cloud", "rtt_seconds", 0.15, at)
    outcome.same("metric rtt_seconds: round trips above 0.15 s before the step", longer, 0)
    longer, _ = measures.above(flight, "cloud", "rtt_seconds", 0.15, soon)
    outcome.least("metric rtt_seconds: round trips above 0.15 s within 5 s of it", longer, 200)


@scenario(
    11,
    "asymmetric-delay",
    injects="10 ms up, 190 ms down, two clocks an hour apart",
    expects="ages use the round trip: flown in TRACK; no one-way delay is claimed",
    shows="cloudrc_rtt_seconds; one-way delays are absent",
)
def _asymmetry(outcome: Outcome, seed: int) -> None:
    delays = "link.uplink.delay_ms=10", "link.downlink.delay_ms=190"
    flight = Flight("link.profile=ideal", *delays, seed=seed, cloud_clock=Clock(HOUR_NS))
    flight.fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.same("HOLDs", len(measures.held(flight)), 0)
    rtt = measures.reading(flight, "cloud", "rtt_seconds")
    outcome.most("metric rtt_seconds, its mean is off 0.2 s by", abs(rtt - 0.2), 0.01, "s")
    arrivals = [r for r in (*flight.of_world, *flight.of_cloud) if isinstance(r, Arrival)]
    outcome.true("no one-way delay is claimed", all(isnan(r.delay) for r in arrivals))


@scenario(
    12,
    "jitter",
    injects="jitter of 40 ms, then of 150 ms about 150 ms",
    expects="first TRACK, then HOLD and TRACK without chatter: <= 2 changes in any second",
    shows="cloudrc_command_age_seconds, cloudrc_guard_transitions_total",
)
def _jitter(outcome: Outcome, seed: int) -> None:
    flight = Flight("link.profile=paper-p3", seed=seed).fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.same("jitter 40 ms: HOLDs", len(measures.held(flight)), 0)
    steady = conditions(jitter=0.0)
    without = Flight("link.profile=paper-p3", seed=seed, uplink=steady, downlink=steady)
    older, old = _above_100_and_150_ms(without.fly_mission())
    outcome.most(f"no jitter: metric {AGE}: share outside 0.1 to 0.15 s", 1 - older + old, 0.01)
    older, old = _above_100_and_150_ms(flight)
    outcome.most(f"jitter 40 ms: metric {AGE}: share above 0.1 s", older, 0.95)
    outcome.least(f"jitter 40 ms: metric {AGE}: share above 0.15 s", old, 0.05)
    wild = conditions(delay=0.15, jitter=0.15)
    flight = Flight(seed=seed, uplink=wild, downlink=wild).fly(60.0)
    measures.safe(outcome, flight)
    measures.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=0.0)
    _, old = measures.above(flight, "world", AGE, 0.15)
    outcome.least(f"jitter 150 ms: metric {AGE}: share above 0.15 s", old, 0.25)
    _, old = measures.above(flight, "world", AGE, 0.25)
    outcome.same(f"jitter 150 ms: metric {AGE}: share above 0.25 s", old, 0.0)
    busiest = measures.busiest_second(flight.changes)
    outcome.most("jitter 150 ms: changes of the guard in any second", busiest, 2)


def _above_100_and_150_ms(flight: Flight) -> tuple[float, float]:
    """Return the shares of commands [1] that were older than 0.1 and 0.15 s when in use."""
    older, old = (measures.above(flight, "world", AGE, age)[1] for age in (0.1, 0.15))
    return older, old
