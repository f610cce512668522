# SPDX-License-Identifier: Apache-2.0

"""Faults F1 to F7 and F9 to F12: loss, reordering, copies, clocks, delay steps and jitter."""

from __future__ import annotations

from math import isnan, nan

from cloudrc.wire.messages import Cause, GuardState
from cloudrc.wire.records import Arrival, Control, GroundTruth
from tests.faults.flight import FaultRun
from tests.faults.measures import (
    Outcome,
    busiest_second,
    calm_after,
    drift,
    first_into,
    held,
    number,
    scenario,
)
from tests.faults.schedule import WAYS, FaultEvent

HOUR = 3600.0  # [s]
STEADY = "link.both.jitter_ms=0"
"""Setting for a link without jitter."""


@scenario(
    1,
    "short-blackout",
    injects="both directions silent for 0.1 s; one of them alone",
    expects="stays in TRACK, no step above the acceleration cap",
)
def _short_silence(outcome: Outcome) -> None:
    """Fly three times: interrupt both directions, then only the uplink, then only the downlink.

    The last two flights have no jitter, because jitter, too, makes gaps between datagrams.
    """
    at = outcome.instant()
    for silent in WAYS:
        what, settings = ("both ways", []) if silent == "both" else (silent, [STEADY])
        flight = outcome.fly(*settings, events=(FaultEvent("blackout", at, 0.1, way=silent),))
        outcome.no_hold(flight, f"silent {what}: HOLDs")
        for way, link in (("up", flight.uplink), ("down", flight.downlink)):
            most = 11 if silent in ("both", way) else 0
            outcome.most(f"silent {what}: datagrams lost, {way}", link.blackouts, most)


@scenario(
    2,
    "blackout",
    injects="both directions silent for 0.5, 3 and 20 s",
    expects="HOLD after 252 ms, below 0.05 m/s in 1 s, drift <= 0.10 m, TRACK <= 1 s after the end",
)
def _silence(outcome: Outcome) -> None:
    at = outcome.instant()
    for duration in (0.5, 3.0, 20.0):
        back, what = at + duration, f"{duration:g} s of silence"
        slow = ("guard.speed_max_mps=1.5", "criteria.time_limit_s=150")
        cut = FaultEvent("blackout", at, duration)
        flight = outcome.fly(*slow, limit=150.0, events=(cut,))
        outcome.held_in_time(flight, f"{what}: HOLD after")
        if duration >= 3.0:
            began = first_into(flight, GuardState.HOLD)
            outcome.most(f"{what}: below 0.05 m/s after", calm_after(flight, began, back), 1.0, "s")
            outcome.most(f"{what}: drift", drift(flight, began + 2.0, back), 0.10, "m")
        resumed = first_into(flight, GuardState.TRACK, back) - back
        outcome.most(f"{what}: resumed after", resumed, 1.0, "s")


@scenario(
    3,
    "long-blackout",
    injects="both directions silent for 75 s, over the floor and among obstacles",
    expects="HOLD; LAND after 60 s at 0.5 m/s; switches off after touch-down; stays in LAND",
)
def _long_silence(outcome: Outcome) -> None:
    """Interrupt the link for 75 s in two flights: above the free floor, and among obstacles."""
    flight = _landed(outcome, outcome.instant(1.6, 2.6), "over the floor")
    first, last = (flight.of(GroundTruth)[n].odometry.position for n in (0, -1))
    outcome.most("over the floor: base above where it took off", abs(last[2] - first[2]), 0.02, "m")
    _landed(outcome, outcome.instant(8.0), "amid obstacles")


def _landed(outcome: Outcome, at: float, where: str) -> FaultRun:
    """Interrupt the link at `at` [s] for 75 s; check that the robot lands and switches off.

    `where` is the place of the robot, for the texts of the checks.
    """
    cut = FaultEvent("blackout", at, 75.0)
    flight = outcome.prepare("criteria.time_limit_s=200", events=(cut,))
    flight.fly(at + 80.0)
    outcome.safe(flight)
    began = first_into(flight, GuardState.HOLD)
    landed = first_into(flight, GuardState.LAND)
    outcome.most(
        f"{where}: deviation of LAND from 60 s after HOLD", abs(landed - began - 60.0), 0.01, "s"
    )
    fallen = [-r.odometry.velocity[2] for r in flight.of(GroundTruth) if r.stamp_ns >= landed * 1e9]
    fastest = max(fallen, default=nan)
    outcome.most(f"{where}: deviation of the descent from 0.5 m/s", abs(fastest - 0.5), 0.05, "m/s")
    fastest = max(flight.robot.simulator.actuators.speeds)
    outcome.most(f"{where}: fastest actuator", fastest, 1.0, "rad/s")
    outcome.true(f"{where}: touched down", flight.changes[-1].cause == Cause.DOWN.words)
    outcome.true(f"{where}: stays in LAND", flight.guard_now()[0] is GuardState.LAND)
    why = f"guard went to LAND ({Cause.ALONE.words})"
    told = flight.mission.state == "failed" and why in str(flight.mission.verdict)
    outcome.true(f"{where}: the mission failed: {why}", told)
    return flight


@scenario(
    4,
    "random-loss",
    injects="30 % independent loss both ways",
    expects="TRACK, tracking error <= 1.5 times that without loss",
)
def _loss(outcome: Outcome) -> None:
    clean = outcome.prepare().fly_mission()
    flight = outcome.fly("link.both.loss=0.3")
    outcome.no_hold(flight)
    error, usual = (number(each, "tracking_rms_measured") for each in (flight, clean))
    outcome.most("tracking error, relative to that without loss", error / usual, 1.5)
    outcome.least("loss in the report", number(flight, "loss_uplink"), 0.25)


@scenario(
    5,
    "burst-loss",
    injects="Gilbert-Elliott loss, mean bursts of 50, 200 and 500 ms",
    expects="at most 2 changes between TRACK and HOLD in any second",
)
def _bursts(outcome: Outcome) -> None:
    for packets in (5, 20, 50):
        loss = f"link.both.loss={{bad_start: 0.005, bad_end: {1 / packets}}}"
        flight = outcome.prepare("criteria.time_limit_s=150", loss).fly_mission(150.0)
        outcome.safe(flight)
        if packets < 50:  # else it hardly ever rests on the body for 4 s, and a leg may time out
            outcome.done(flight)
        outcome.true("the mission has ended", flight.mission.ended)
        text, busiest = f"bursts of {packets * 10} ms", busiest_second(flight.changes)
        outcome.most(f"{text}: changes of the guard in any second", busiest, 2)
        left_out = len(held(flight)) - number(flight, "hold_count")
        outcome.same(f"{text}: HOLDs that the report leaves out", left_out, 0)


@scenario(
    6,
    "reordering",
    injects="25 % of the datagrams overtake the others by 50 ms",
    expects="late commands are dropped, never applied",
)
def _disorder(outcome: Outcome) -> None:
    link = STEADY, "link.both.delay_ms=50"
    outcome.least("late commands dropped", outcome.fly(*link, reorder=0.25).count("late"), 100)


@scenario(
    7,
    "duplication",
    injects="every datagram arrives twice, on a link without jitter, which keeps the order",
    expects="the same path, bit by bit",
)
def _copies(outcome: Outcome) -> None:
    clean = outcome.prepare(STEADY).fly_mission()
    flight = outcome.fly(STEADY, duplicate=1.0)
    same = clean.of(GroundTruth) == flight.of(GroundTruth)
    outcome.true("the same path, bit by bit", same)
    outcome.least("copies dropped", flight.count("repeated"), 1000)


@scenario(
    9,
    "clock-steps",
    injects="cloud's clock is 47 h or 49 h ahead of world's, or drifts by 500 ppm",
    expects="the same path, bit by bit; no HOLD with the drift",
)
def _clocks(outcome: Outcome) -> None:
    clean = outcome.prepare().fly_mission()
    for hours in (47, 49):
        apart = outcome.prepare(cloud_offset=hours * HOUR).fly_mission()
        text = f"cloud's clock {hours} h ahead: the same path, bit by bit"
        outcome.true(text, clean.of(GroundTruth) == apart.of(GroundTruth))
    for ppm in (-500, 500):
        drifting = outcome.fly(cloud_offset=HOUR, cloud_drift=ppm)
        outcome.no_hold(drifting, f"drift of {ppm} ppm: HOLDs")


@scenario(
    10,
    "delay-step",
    injects="the round trip steps from 20 to 200 ms",
    expects="estimator `split` within 20 % in 0.5 s; no HOLD; the caps hold",
)
def _delay_step(outcome: Outcome) -> None:
    at = outcome.instant()
    link = "cloud.estimator=split", "link.both.delay_ms=10", "link.both.jitter_ms=1"
    flight = outcome.fly(*link, events=(FaultEvent("delay", at, HOUR, 0.09),))
    off = [
        abs(r.horizon - r.loop_delay) / r.loop_delay
        for r in flight.of_cloud
        if isinstance(r, Control) and at + 0.5 <= r.stamp_ns * 1e-9 < at + 2.0
    ]
    outcome.most("relative error of the delay estimate after 0.5 s", max(off, default=nan), 0.2)
    outcome.no_hold(flight)


@scenario(
    11,
    "asymmetric-delay",
    injects="10 ms up, 190 ms down, two clocks an hour apart",
    expects="no HOLD, because ages need only one clock; no one-way delay is reported",
)
def _asymmetry(outcome: Outcome) -> None:
    delays = "link.uplink.delay_ms=10", "link.downlink.delay_ms=190"
    flight = outcome.fly(*delays, profile="ideal", cloud_offset=HOUR)
    outcome.no_hold(flight)
    rtt = number(flight, "rtt_mean")
    outcome.most("deviation of the mean round trip from 0.2 s", abs(rtt - 0.2), 0.01, "s")
    arrivals = [r for r in (*flight.of_world, *flight.of_cloud) if isinstance(r, Arrival)]
    outcome.true("no one-way delay is reported", all(isnan(r.delay) for r in arrivals))


@scenario(
    12,
    "jitter",
    injects="jitter of 40 ms, then a delay of 150 ms with 150 ms of jitter",
    expects="first no HOLD; then at most 2 changes between TRACK and HOLD in any second",
)
def _jitter(outcome: Outcome) -> None:
    outcome.no_hold(outcome.fly(profile="paper-p3"), "jitter 40 ms: HOLDs")
    link = "link.both.delay_ms=150", "link.both.jitter_ms=150"
    flight = outcome.prepare(*link).fly(60.0)
    outcome.safe(flight)
    busiest = busiest_second(flight.changes)
    outcome.most("jitter 150 ms: changes of the guard in any second", busiest, 2)
