"""Faults F1 to F7 and F9 to F12: loss, reordering, copies, clocks, delay steps and jitter."""

from __future__ import annotations

from math import isnan, nan

from cloudrc.faults import measures
from cloudrc.faults.flight import FaultRun
from cloudrc.faults.measures import Outcome, fly_safely, scenario
from cloudrc.faults.schedule import WAYS, FaultEvent, Schedule
from cloudrc.messages import Cause, GuardState
from cloudrc.records import Arrival, Control

HOUR = 3600.0  # [s]
STEADY = "link.both.jitter_ms=0"
"""Setting for a link without jitter."""


@scenario(
    1,
    "short-blackout",
    injects="both directions silent for 0.1 s; one of them alone",
    expects="stays in TRACK, no step above the acceleration cap",
)
def _short_silence(outcome: Outcome, seed: int) -> None:
    """Fly three times: interrupt both directions, then only the uplink, then only the downlink.

    The last two flights have no jitter, because jitter, too, makes gaps between datagrams.
    """
    at = measures.instant(seed)
    for silent in WAYS:
        what, settings = ("both ways", []) if silent == "both" else (silent, [STEADY])
        cut = Schedule(seed, events=(FaultEvent("blackout", at, 0.1, way=silent),))
        flight = fly_safely(outcome, FaultRun(cut, *settings))
        outcome.same(f"silent {what}: HOLDs", len(measures.held(flight)), 0)
        for way, link in (("up", flight.uplink), ("down", flight.downlink)):
            most = 11 if silent in ("both", way) else 0
            outcome.most(f"silent {what}: datagrams lost, {way}", link.blackouts, most)


@scenario(
    2,
    "blackout",
    injects="both directions silent for 0.5, 3 and 20 s",
    expects="HOLD after 252 ms, below 0.05 m/s in 1 s, drift <= 0.10 m, TRACK <= 1 s after the end",
)
def _silence(outcome: Outcome, seed: int) -> None:
    at = measures.instant(seed)
    for duration in (0.5, 3.0, 20.0):
        back, what = at + duration, f"{duration:g} s of silence"
        slow = ("guard.speed_max_mps=1.5", "criteria.time_limit_s=150")
        cut = Schedule(seed, events=(FaultEvent("blackout", at, duration),))
        flight = fly_safely(outcome, FaultRun(cut, *slow), 150.0)
        measures.held_in_time(outcome, flight, f"{what}: HOLD after")
        if duration >= 3.0:
            began = measures.first_into(flight, GuardState.HOLD)
            calm = measures.calm_after(flight, began, back)
            outcome.most(f"{what}: below 0.05 m/s after", calm, 1.0, "s")
            drift = measures.drift(flight, began + 2.0, back)
            outcome.most(f"{what}: drift", drift, 0.10, "m")
        outcome.most(f"{what}: resumed after", measures.resumed_after(flight, back), 1.0, "s")


@scenario(
    3,
    "long-blackout",
    injects="both directions silent for 75 s, over the floor and among obstacles",
    expects="HOLD; LAND after 60 s at 0.5 m/s; switches off after touch-down; stays in LAND",
)
def _long_silence(outcome: Outcome, seed: int) -> None:
    """Interrupt the link for 75 s in two flights: above the free floor, and among obstacles."""
    flight = _landed(outcome, seed, measures.instant(seed, 1.6, 2.6), "over the floor")
    first, last = (flight.trajectory()[n].odometry.position for n in (0, -1))
    text = "over the floor: base above where it took off"
    outcome.most(text, abs(last[2] - first[2]), 0.02, "m")
    _landed(outcome, seed, measures.instant(seed, 8.0), "amid obstacles")


def _landed(outcome: Outcome, seed: int, at: float, where: str) -> FaultRun:
    """Interrupt the link at `at` [s] for 75 s; check that the robot lands and switches off.

    `where` is the place of the robot, for the texts of the checks.
    """
    cut = Schedule(seed, events=(FaultEvent("blackout", at, 75.0),))
    flight = FaultRun(cut, "criteria.time_limit_s=200")
    flight.fly(at + 80.0)
    measures.safe(outcome, flight)
    held = measures.first_into(flight, GuardState.HOLD)
    landed = measures.first_into(flight, GuardState.LAND)
    outcome.most(
        f"{where}: deviation of LAND from 60 s after HOLD", abs(landed - held - 60.0), 0.01, "s"
    )
    fallen = [-r.odometry.velocity[2] for r in flight.trajectory() if r.stamp_ns >= landed * 1e9]
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
def _loss(outcome: Outcome, seed: int) -> None:
    clean = FaultRun(Schedule(seed)).fly_mission()
    flight = fly_safely(outcome, FaultRun(Schedule(seed), "link.both.loss=0.3"))
    outcome.same("HOLDs", len(measures.held(flight)), 0)
    error, usual = (measures.number(each, "tracking_rms_measured") for each in (flight, clean))
    outcome.most("tracking error, relative to that without loss", error / usual, 1.5)
    outcome.least("loss in the report", measures.number(flight, "loss_uplink"), 0.25)


@scenario(
    5,
    "burst-loss",
    injects="Gilbert-Elliott loss, mean bursts of 50, 200 and 500 ms",
    expects="at most 2 changes between TRACK and HOLD in any second",
)
def _bursts(outcome: Outcome, seed: int) -> None:
    for packets in (5, 20, 50):
        loss = f"link.both.loss={{bad_start: 0.005, bad_end: {1 / packets}}}"
        flight = FaultRun(Schedule(seed), "criteria.time_limit_s=150", loss).fly_mission(150.0)
        measures.safe(outcome, flight)
        if packets < 50:  # else it hardly ever rests on the body for 4 s, and a leg may time out
            measures.done(outcome, flight)
        outcome.true("the mission has ended", flight.mission.ended)
        text, busiest = f"bursts of {packets * 10} ms", measures.busiest_second(flight.changes)
        outcome.most(f"{text}: changes of the guard in any second", busiest, 2)
        told, held = measures.number(flight, "hold_count"), len(measures.held(flight))
        outcome.same(f"{text}: HOLDs that the report leaves out", held - told, 0)


@scenario(
    6,
    "reordering",
    injects="25 % of the datagrams overtake the others by 50 ms",
    expects="late commands are dropped, never applied",
)
def _disorder(outcome: Outcome, seed: int) -> None:
    link = STEADY, "link.both.delay_ms=50"
    flight = fly_safely(outcome, FaultRun(Schedule(seed, reorder=0.25), *link))
    outcome.least("late commands dropped", flight.count("late"), 100)


@scenario(
    7,
    "duplication",
    injects="every datagram arrives twice, on a link without jitter, which keeps the order",
    expects="the same path, bit by bit",
)
def _copies(outcome: Outcome, seed: int) -> None:
    clean = FaultRun(Schedule(seed), STEADY).fly_mission()
    flight = fly_safely(outcome, FaultRun(Schedule(seed, duplicate=1.0), STEADY))
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
    clean = FaultRun(Schedule(seed)).fly_mission()
    for hours in (47, 49):
        apart = FaultRun(Schedule(seed, cloud_offset=hours * HOUR)).fly_mission()
        text = f"cloud's clock {hours} h ahead: the same path, bit by bit"
        outcome.true(text, clean.trajectory() == apart.trajectory())
    for ppm in (-500, 500):
        drift = Schedule(seed, cloud_offset=HOUR, cloud_drift=ppm)
        drifting = fly_safely(outcome, FaultRun(drift))
        outcome.same(f"drift of {ppm} ppm: HOLDs", len(measures.held(drifting)), 0)


@scenario(
    10,
    "delay-step",
    injects="the round trip steps from 20 to 200 ms",
    expects="estimator `split` within 20 % in 0.5 s; no HOLD; the caps hold",
)
def _delay_step(outcome: Outcome, seed: int) -> None:
    at = measures.instant(seed)
    link = "cloud.estimator=split", "link.both.delay_ms=10", "link.both.jitter_ms=1"
    step = Schedule(seed, events=(FaultEvent("delay", at, HOUR, 0.09),))
    flight = fly_safely(outcome, FaultRun(step, *link))
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
    apart = Schedule(seed, "ideal", cloud_offset=HOUR)
    delays = "link.uplink.delay_ms=10", "link.downlink.delay_ms=190"
    flight = fly_safely(outcome, FaultRun(apart, *delays))
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
    flight = fly_safely(outcome, FaultRun(Schedule(seed, "paper-p3")))
    outcome.same("jitter 40 ms: HOLDs", len(measures.held(flight)), 0)
    link = "link.both.delay_ms=150", "link.both.jitter_ms=150"
    flight = FaultRun(Schedule(seed), *link).fly(60.0)
    measures.safe(outcome, flight)
    busiest = measures.busiest_second(flight.changes)
    outcome.most("jitter 150 ms: changes of the guard in any second", busiest, 2)
