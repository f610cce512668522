"""Faults F6, F7 and F9 to F12: reordering, copies, clocks, delay steps, asymmetry and jitter."""

from __future__ import annotations

from math import isnan, nan

from cloudrc.drivers.virtual import Clock
from cloudrc.faults import measures
from cloudrc.faults.flight import Flight, conditions
from cloudrc.faults.measures import fly_safely
from cloudrc.faults.scenario import Outcome, scenario
from cloudrc.link.profile import Change
from cloudrc.records import Arrival, Control

HOUR_NS = 3_600_000_000_000


@scenario(
    6,
    "reordering",
    injects="25 % of the datagrams overtake the others by 50 ms",
    expects="late commands are dropped, never applied",
)
def _disorder(outcome: Outcome, seed: int) -> None:
    shape = conditions(delay=0.05, jitter=0.0, reorder=0.25)
    flight = fly_safely(outcome, Flight(seed=seed, link=shape))
    outcome.least("late commands dropped", flight.count("late"), 100)


@scenario(
    7,
    "duplication",
    injects="every datagram arrives twice, on a link without jitter, which keeps the order",
    expects="the same path, bit by bit",
)
def _copies(outcome: Outcome, seed: int) -> None:
    clean = Flight(seed=seed, link=conditions(jitter=0.0)).fly_mission()
    twice = conditions(jitter=0.0, duplicate=1.0)
    flight = fly_safely(outcome, Flight(seed=seed, link=twice))
    same = clean.trajectory() == flight.trajectory()
    outcome.true("the same path, bit by bit", same)
    outcome.least("copies dropped", flight.count("repeated"), 1000)


@scenario(
    9,
    "clock-steps",
    injects="cloud's clock is 47 h or 49 h ahead of world's, or drifts by 500 ppm",
    expects="the same path, bit by bit; no HOLD with the drift",
)
def _clocks(outcome: Outcome, seed: int) -> None:
    clean = Flight(seed=seed).fly_mission()
    for hours in (47, 49):
        apart = Flight(seed=seed, cloud_clock=Clock(hours * HOUR_NS)).fly_mission()
        text = f"cloud's clock {hours} h ahead: the same path, bit by bit"
        outcome.true(text, clean.trajectory() == apart.trajectory())
    for ppm in (-500, 500):
        drifting = fly_safely(outcome, Flight(seed=seed, cloud_clock=Clock(HOUR_NS, ppm)))
        outcome.same(f"drift of {ppm} ppm: HOLDs", len(measures.held(drifting)), 0)


@scenario(
    10,
    "delay-step",
    injects="the round trip steps from 20 to 200 ms",
    expects="estimator `split` within 20 % in 0.5 s; no HOLD; the caps hold",
)
def _delay_step(outcome: Outcome, seed: int) -> None:
    at = measures.instant(seed)
    shape = conditions(delay=0.01, jitter=0.001, changes=(Change(at, delay=0.1),))
    flight = fly_safely(outcome, Flight("cloud.estimator=split", seed=seed, link=shape))
    off = [
        abs(r.horizon - r.loop_delay) / r.loop_delay
        for r in flight.of_cloud
        if isinstance(r, Control) and at + 0.5 <= r.stamp_ns * 1e-9 < at + 2.0
    ]
    outcome.most("relative error of the delay estimate after 0.5 s", max(off, default=nan), 0.2)
    outcome.same("HOLDs", len(measures.held(flight)), 0)


@scenario(
    11,
    "asymmetric-delay",
    injects="10 ms up, 190 ms down, two clocks an hour apart",
    expects="no HOLD, because ages need only one clock; no one-way delay is reported",
)
def _asymmetry(outcome: Outcome, seed: int) -> None:
    settings = "link.profile=ideal", "link.uplink.delay_ms=10", "link.downlink.delay_ms=190"
    flight = fly_safely(outcome, Flight(*settings, seed=seed, cloud_clock=Clock(HOUR_NS)))
    outcome.same("HOLDs", len(measures.held(flight)), 0)
    rtt = measures.number(flight, "rtt_mean")
    outcome.most("deviation of the mean round trip from 0.2 s", abs(rtt - 0.2), 0.01, "s")
    arrivals = [r for r in (*flight.of_world, *flight.of_cloud) if isinstance(r, Arrival)]
    outcome.true("no one-way delay is reported", all(isnan(r.delay) for r in arrivals))


@scenario(
    12,
    "jitter",
    injects="jitter of 40 ms, then a delay of 150 ms with 150 ms of jitter",
    expects="first no HOLD; then at most 2 changes between TRACK and HOLD in any second",
)
def _jitter(outcome: Outcome, seed: int) -> None:
    flight = fly_safely(outcome, Flight("link.profile=paper-p3", seed=seed))
    outcome.same("jitter 40 ms: HOLDs", len(measures.held(flight)), 0)
    flight = Flight(seed=seed, link=conditions(delay=0.15, jitter=0.15)).fly(60.0)
    measures.safe(outcome, flight)
    busiest = measures.busiest_second(flight.changes)
    outcome.most("jitter 150 ms: changes of the guard in any second", busiest, 2)
