"""Faults F1 to F5: the link loses datagrams during blackouts, at random and in bursts."""

from __future__ import annotations

from math import nan

from cloudrc.faults import measures
from cloudrc.faults.flight import Flight, conditions, silent
from cloudrc.faults.measures import fly_safely
from cloudrc.faults.scenario import Outcome, scenario
from cloudrc.link.profile import GilbertElliott
from cloudrc.messages import Cause, GuardState


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
    both, steady = silent(at, 0.1), conditions(jitter=0.0)
    cut = silent(at, 0.1, jitter=0.0)
    cases = {"both ways": (both, both), "up": (cut, steady), "down": (steady, cut)}
    for what, (up, down) in cases.items():
        flight = fly_safely(outcome, Flight(seed=seed, uplink=up, downlink=down))
        outcome.same(f"silent {what}: HOLDs", len(measures.held(flight)), 0)
        for way, link, shape in (("up", flight.uplink, up), ("down", flight.downlink, down)):
            lost, most = link.counts()["blackout"], 0 if shape is steady else 11
            outcome.most(f"silent {what}: datagrams lost, {way}", lost, most)


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
        flight = Flight(*slow, seed=seed, link=silent(at, duration))
        fly_safely(outcome, flight, 150.0)
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
    injects="both directions silent for 75 s, over the floor and among the pipes",
    expects="HOLD; LAND after 60 s at 0.5 m/s; rotors stop after touch-down; stays in LAND",
)
def _long_silence(outcome: Outcome, seed: int) -> None:
    """Interrupt the link for 75 s in two flights: above the free floor, and among the pipes."""
    flight = _landed(outcome, seed, measures.instant(seed, 1.6, 2.6), "over the floor")
    first, last = (flight.trajectory()[n].odometry.position for n in (0, -1))
    text = "over the floor: base above where it took off"
    outcome.most(text, abs(last[2] - first[2]), 0.02, "m")
    _landed(outcome, seed, measures.instant(seed, 8.0), "amid the pipes")


def _landed(outcome: Outcome, seed: int, at: float, where: str) -> Flight:
    """Interrupt the link at `at` [s] for 75 s; check that the robot lands and stops its rotors.

    `where` is the place of the robot, for the texts of the checks.
    """
    limit = "criteria.time_limit_s=200"
    flight = Flight(limit, seed=seed, link=silent(at, 75.0))
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
    rotor = max(flight.robot.simulator.rotor_speeds)
    outcome.most(f"{where}: fastest rotor", rotor, 1.0, "rad/s")
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
    clean = Flight(seed=seed).fly_mission()
    flight = fly_safely(outcome, Flight(seed=seed, link=conditions(loss=0.3)))
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
        shape = conditions(loss=GilbertElliott(bad_start=1 / 200, bad_end=1 / packets))
        flight = Flight("criteria.time_limit_s=150", seed=seed, link=shape).fly_mission(150.0)
        measures.safe(outcome, flight)
        if packets < 50:  # else it hardly ever rests on the board for 4 s, and a leg may time out
            measures.done(outcome, flight)
        outcome.true("the mission has ended", flight.mission.ended)
        text, busiest = f"bursts of {packets * 10} ms", measures.busiest_second(flight.changes)
        outcome.most(f"{text}: changes of the guard in any second", busiest, 2)
        told, held = measures.number(flight, "hold_count"), len(measures.held(flight))
        outcome.same(f"{text}: HOLDs that the report leaves out", held - told, 0)
