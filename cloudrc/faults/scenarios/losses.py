"""Faults F1 to F5: the link loses datagrams, in silences, by chance and in bursts."""

from __future__ import annotations

from dataclasses import replace
from math import hypot, nan

from cloudrc.faults import measures
from cloudrc.faults.flight import Flight, Shape, blackouts
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.link.profile import GilbertElliott
from cloudrc.messages import Cause, GuardState


def _short_silence(seed: int) -> Outcome:
    """Cut both directions, then one of them on a link without jitter, which has no other gaps."""
    outcome, at = Outcome(), measures.instant(seed)
    cut = blackouts((at, 0.1))
    steady: Shape = lambda profile: replace(profile, jitter=0.0)  # noqa: E731
    silent: Shape = lambda profile: steady(cut(profile))  # noqa: E731
    for what, up, down in (
        ("both ways", cut, cut),
        ("up", silent, steady),
        ("down", steady, silent),
    ):
        flight = Flight(seed=seed, uplink=up, downlink=down).fly_mission()
        measures.safe_and_done(outcome, flight)
        outcome.same(f"silent {what}: HOLDs", len(measures.held(flight)), 0)
        ends = ("cloud", "uplink", flight.uplink, up), ("world", "downlink", flight.downlink, down)
        for role, way, link, shape in ends:
            lost, gaps = link.counts()["blackout"], _gaps(flight, role, at)
            text = f"silent {what}: metric link_gap_seconds of {role}: gaps above 50 ms"
            if shape is steady:
                outcome.same(text, gaps, 0)
                outcome.same(f"silent {what}: datagrams lost, {way}", lost, 0)
                continue
            outcome.least(text, gaps, 1)
            outcome.most(f"silent {what}: datagrams lost, {way}", lost, 11)
            measures.moves(outcome, flight, role, "datagrams_lost_total", way, since=at)
    return outcome


def _gaps(flight: Flight, role: str, at: float) -> int:
    """Return how many gaps above 50 ms an end shows within 5 s of a fault that begins `at` [s]."""
    sights = [measures.seen_by(flight, role, until) for until in (at, at + measures.SOON)]
    before, after = (measures.above(role, seen, "link_gap_seconds", 0.05)[0] for seen in sights)
    return after - before


def _silence(seed: int) -> Outcome:
    outcome, at = Outcome(), measures.instant(seed)
    for duration in (0.5, 3.0, 20.0):
        cut = blackouts((at, duration))
        flight = Flight(
            "guard.speed_max_mps=1.5",
            "criteria.time_limit_s=150",
            seed=seed,
            uplink=cut,
            downlink=cut,
            separate=True,
        )
        shown = measures.look(flight, at + 0.9 * duration)
        flight.fly_mission(150.0)
        measures.safe_and_done(outcome, flight)
        began = next(iter(measures.changes_into(flight, GuardState.HOLD)), at)
        what = f"{duration:g} s of silence"
        measures.held_in_time(outcome, flight, f"{what}: HOLD after")
        measures.causes_told(outcome, flight, what)
        back = at + duration
        if duration >= 3.0:
            outcome.most(
                f"{what}: below 0.05 m/s after", measures.stopping_time(flight, began), 1.0, "s"
            )
            outcome.most(f"{what}: drift", measures.drift(flight, began + 2.0, back), 0.10, "m")
            measures.silence_told(outcome, shown, 0.9 * duration, cloud=True, what=what)
        measures.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=at)
        measures.moves(outcome, flight, "cloud", "commands_frozen_total", since=at)
        outcome.most(f"{what}: resumed after", measures.resumed_after(flight, back), 1.0, "s")
    return outcome


def _long_silence(seed: int) -> Outcome:
    """Cut the link over the free floor, and anywhere on the way through the pipes."""
    outcome = Outcome()
    flight = _silent(outcome, seed, measures.instant(seed, 1.6, 2.6), "over the floor")
    first, last = flight.trajectory()[0].odometry, flight.trajectory()[-1].odometry
    height = last.position[2] - first.position[2]
    outcome.most("over the floor: base above where it took off", abs(height), 0.02, "m")
    flight = _silent(outcome, seed, measures.instant(seed, 8.0), "amid the pipes")
    text = "amid the pipes: things other than the floor that it came down on, told and no collision"
    outcome.most(text, len(flight.watch.landed_on), 1)
    return outcome


def _silent(outcome: Outcome, seed: int, at: float, where: str) -> Flight:
    """Cut the link at `at` [s] for long: the robot lands and stops its rotors."""
    cut = blackouts((at, 75.0))
    flight = Flight("criteria.time_limit_s=200", seed=seed, uplink=cut, downlink=cut, separate=True)
    shown = measures.look(flight, at + 70.0)
    flight.fly(at + 80.0)
    measures.safe(outcome, flight)
    measures.silence_told(outcome, shown, 70.0, cloud=True, what=where)
    held = next(iter(measures.changes_into(flight, GuardState.HOLD)), -1.0)
    lands = measures.changes_into(flight, GuardState.LAND)
    landed = lands[0] if lands else nan
    outcome.most(f"{where}: LAND after HOLD", landed - held, 60.01, "s")
    outcome.least(f"{where}: LAND not before", landed - held, 59.99, "s")
    path = [r for r in flight.trajectory() if r.stamp_ns * 1e-9 >= landed]
    fastest = max((-r.odometry.velocity[2] for r in path), default=nan)
    outcome.most(f"{where}: descent", fastest, 0.55, "m/s")
    outcome.least(f"{where}: descent not slower than", fastest, 0.45, "m/s")
    outcome.most(f"{where}: speed at last", hypot(*path[-1].odometry.velocity), 0.01, "m/s")
    rotor = max(flight.robot.simulator.rotor_speeds)
    outcome.most(f"{where}: fastest rotor", rotor, 1.0, "rad/s")
    told = flight.changes[-1].cause == Cause.DOWN.words
    outcome.true(f"{where}: the last change says so", told)
    flown = [t for t in measures.changes_into(flight, GuardState.TRACK) if t > landed]
    outcome.true(f"{where}: it stays down until the operator acknowledges", not flown)
    measures.landing_told(outcome, flight)
    measures.moves(outcome, flight, "world", "guard_state", since=at)
    outcome.least(
        "metric guard_state at the end", measures.metric(flight, "world", "guard_state"), 3
    )
    return flight


def _loss(seed: int) -> Outcome:
    outcome = Outcome()
    lossy: Shape = lambda profile: replace(profile, loss=0.3)  # noqa: E731
    clean = Flight(seed=seed).fly_mission()
    flight = Flight(seed=seed, uplink=lossy, downlink=lossy).fly_mission()
    measures.safe_and_done(outcome, flight)
    outcome.same("HOLDs", len(measures.held(flight)), 0)
    ratio = measures.number(flight, "tracking_rms_measured") / measures.number(
        clean, "tracking_rms_measured"
    )
    outcome.most("tracking error over that without loss", ratio, 1.5)
    lost = "datagrams_lost_total"
    for role, way in (("world", "downlink"), ("cloud", "uplink")):
        measures.moves(outcome, flight, role, lost, way, since=0.0)
        outcome.least(f"metric {lost} {way}", measures.metric(flight, role, lost, way), 500)
    outcome.least("loss shown", measures.number(flight, "loss_uplink"), 0.25)
    return outcome


def _bursts(seed: int) -> Outcome:
    outcome = Outcome()
    for packets in (5, 20, 50):
        bursts = GilbertElliott(bad_start=1 / 200, bad_end=1 / packets)
        shape: Shape = lambda profile, bursts=bursts: replace(profile, loss=bursts)  # type: ignore[misc]  # noqa: E731
        flight = Flight(
            "criteria.time_limit_s=150", seed=seed, uplink=shape, downlink=shape
        ).fly_mission(150.0)
        measures.safe(outcome, flight)
        if packets < 50:  # else it hardly ever rests on the board for 4 s, and a leg may time out
            measures.done(outcome, flight)
        outcome.true("the mission has ended", flight.mission.ended)
        # Most bursts do nothing: the fault is the first one that is too long.
        since = next(iter(measures.changes_into(flight, GuardState.HOLD)), nan) - measures.AGE_MAX
        measures.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=since)
        text = f"bursts of {packets * 10} ms: "
        outcome.most(
            f"{text}changes of the guard in any second", measures.busiest_second(flight.changes), 2
        )
        told, held = measures.number(flight, "hold_count"), len(measures.held(flight))
        outcome.same(f"{text}HOLDs that the report leaves out", held - told, 0)
    return outcome


SCENARIOS = (
    Scenario(
        1,
        "short-blackout",
        "both directions silent for 0.1 s; one of them alone",
        "stays in TRACK, no step above the acceleration cap",
        "at most 11 samples per direction, none in one that is not silent",
        "cloudrc_link_gap_seconds and cloudrc_datagrams_lost_total of who hears nothing",
        _short_silence,
    ),
    Scenario(
        2,
        "blackout",
        "both directions silent for 0.5, 3 and 20 s",
        "HOLD at 252 ms, below 0.05 m/s in 1 s, drift <= 0.10 m, resumes <= 1 s after return",
        "samples in the gap",
        "guard HOLD with its cause; in the status: robot not heard, cloud heard; "
        "cloudrc_guard_transitions_total",
        _silence,
    ),
    Scenario(
        3,
        "long-blackout",
        "both directions silent for 75 s, over the floor and amid the pipes",
        "HOLD, LAND after 60 s at 0.5 m/s, rotors stop on what lies below, latched",
        "the mission, which says so",
        "guard LAND with its cause; in the status: robot not heard, cloud heard; "
        "cloudrc_guard_state",
        _long_silence,
    ),
    Scenario(
        4,
        "random-loss",
        "30 % independent loss both ways",
        "TRACK, tracking error <= 1.5 times that without loss",
        "30 % of the samples",
        "cloudrc_datagrams_lost_total, loss in the report",
        _loss,
    ),
    Scenario(
        5,
        "burst-loss",
        "Gilbert-Elliott loss, mean bursts of 50, 200 and 500 ms",
        "TRACK and HOLD without chatter: <= 2 changes in any second",
        "samples, in bursts; with those of 500 ms perhaps a mission, which says so",
        "HOLDs in the report, cloudrc_guard_transitions_total",
        _bursts,
    ),
)
