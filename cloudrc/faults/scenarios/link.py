"""Faults of the link that lose datagrams: silence, short and long, loss, loss in bursts.

Faults of names: what the peer is called leads nowhere for a while, then somewhere else.

Everything at once: the link, both ends and teleop freeze one by one, and return by chance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import hypot, nan
from typing import NamedTuple

import numpy as np

from cloudrc.faults import asks
from cloudrc.faults import asks as meters
from cloudrc.faults.flight import Flight, Shape, blackouts
from cloudrc.faults.held import AGE_MAX
from cloudrc.faults.scenario import Outcome, Scenario, generator
from cloudrc.link.follow import PEER_PAUSE, PeerName
from cloudrc.link.profile import GilbertElliott
from cloudrc.messages import Cause, GuardState
from cloudrc.records import Counted, Record

HOUR_NS = 3_600_000_000_000


def instant(seed: int, first: float = 4.0, last: float = 24.0) -> float:
    """Choose when a fault begins [s]: anywhere in the flight through the pipes.

    Args:
        seed: Of the scenario.
        first: Earliest instant [s].
        last: Latest instant [s].
    """
    return float(generator(seed, 77).uniform(first, last))


def _short_silence(seed: int) -> Outcome:
    """Both ways amid the jitter; one way without it, where every longer gap is the silence."""
    outcome, at = Outcome(), instant(seed)
    cut = blackouts((at, 0.1))
    steady: Shape = lambda profile: replace(profile, jitter=0.0)  # noqa: E731
    silent: Shape = lambda profile: steady(cut(profile))  # noqa: E731
    for what, up, down in (
        ("both ways", cut, cut),
        ("up", silent, steady),
        ("down", steady, silent),
    ):
        flight = Flight(seed=seed, uplink=up, downlink=down).fly_mission()
        asks.safe(outcome, flight)
        asks.done(outcome, flight)
        outcome.same(f"silent {what}: HOLDs", len(asks.held(flight)), 0)
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
            meters.moves(outcome, flight, role, "datagrams_lost_total", way, since=at)
    return outcome


def _gaps(flight: Flight, role: str, at: float) -> int:
    """How many gaps above 50 ms an end has shown within 5 s of a fault that begins `at` [s]."""
    sights = [meters.seen_by(flight, role, until) for until in (at, at + meters.SOON)]
    before, after = (meters.above(role, seen, "link_gap_seconds", 0.05) for seen in sights)
    return after - before


def _silence(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed)
    for duration in (0.5, 3.0, 20.0):
        cut = blackouts((at, duration))
        flight = Flight(
            "guard.speed_max_mps=1.5",
            "criteria.time_limit_s=150",
            seed=seed,
            uplink=cut,
            downlink=cut,
            apart=True,
        )
        shown = asks.look(flight, at + 0.9 * duration)
        flight.fly_mission(150.0)
        asks.safe(outcome, flight)
        asks.done(outcome, flight)
        began = next(iter(asks.changes_into(flight, GuardState.HOLD)), at)
        what = f"{duration:g} s of silence"
        outcome.most(f"{what}: HOLD after", asks.basis_age_at_hold(flight), AGE_MAX, "s")
        asks.causes_told(outcome, flight, what)
        back = at + duration
        if duration >= 3.0:
            outcome.most(
                f"{what}: below 0.05 m/s after", asks.stopping_time(flight, began), 1.0, "s"
            )
            outcome.most(f"{what}: drift", asks.drift(flight, began + 2.0, back), 0.10, "m")
            asks.silence_told(outcome, shown, 0.9 * duration, cloud=True, what=what)
        meters.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=at)
        meters.moves(outcome, flight, "cloud", "commands_frozen_total", since=at)
        outcome.most(f"{what}: resumed after", asks.resumed_after(flight, back), 1.0, "s")
    return outcome


def _long_silence(seed: int) -> Outcome:
    """Over the free floor, and anywhere on the way through the pipes."""
    outcome = Outcome()
    flight = _silent(outcome, seed, instant(seed, 1.6, 2.6), "over the floor")
    first, last = flight.trajectory()[0].odometry, flight.trajectory()[-1].odometry
    height = last.position[2] - first.position[2]
    outcome.most("over the floor: base above where it took off", abs(height), 0.02, "m")
    flight = _silent(outcome, seed, instant(seed, 8.0), "amid the pipes")
    text = "amid the pipes: things other than the floor that it came down on, told and no collision"
    outcome.most(text, len(flight.watch.landed_on), 1)
    return outcome


def _silent(outcome: Outcome, seed: int, at: float, where: str) -> Flight:
    """Silence that begins somewhere, and lasts: the robot lands and lies, its rotors off."""
    cut = blackouts((at, 75.0))
    flight = Flight("criteria.time_limit_s=200", seed=seed, uplink=cut, downlink=cut, apart=True)
    shown = asks.look(flight, at + 70.0)
    flight.fly(at + 80.0)
    asks.safe(outcome, flight)
    asks.silence_told(outcome, shown, 70.0, cloud=True, what=where)
    held = next(iter(asks.changes_into(flight, GuardState.HOLD)), -1.0)
    lands = asks.changes_into(flight, GuardState.LAND)
    landed = lands[0] if lands else nan
    outcome.most(f"{where}: LAND after HOLD", landed - held, 60.01, "s")
    outcome.least(f"{where}: LAND not before", landed - held, 59.99, "s")
    path = [r for r in flight.trajectory() if r.stamp_ns * 1e-9 >= landed]
    fastest = max((-r.odometry.velocity[2] for r in path), default=nan)
    outcome.most(f"{where}: descent", fastest, 0.55, "m/s")
    outcome.least(f"{where}: descent not slower than", fastest, 0.45, "m/s")
    outcome.most(f"{where}: speed at last", hypot(*path[-1].odometry.velocity), 0.01, "m/s")
    rotor = max(flight.robot.simulator._rotors.speeds)
    outcome.most(f"{where}: fastest rotor", rotor, 1.0, "rad/s")
    told = flight.changes[-1].cause == Cause.DOWN.words
    outcome.true(f"{where}: the last change says so", told)
    flown = [t for t in asks.changes_into(flight, GuardState.TRACK) if t > landed]
    outcome.true(f"{where}: it stays down until the operator acknowledges", not flown)
    asks.landing_told(outcome, flight)
    meters.moves(outcome, flight, "world", "guard_state", since=at)
    outcome.least("metric guard_state at the end", asks.metric(flight, "world", "guard_state"), 3)
    return flight


def _loss(seed: int) -> Outcome:
    outcome = Outcome()
    lossy: Shape = lambda profile: replace(profile, loss=0.3)  # noqa: E731
    clean = Flight(seed=seed).fly_mission()
    flight = Flight(seed=seed, uplink=lossy, downlink=lossy).fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.same("HOLDs", len(asks.held(flight)), 0)
    ratio = asks.number(flight, "tracking_rms_measured") / asks.number(
        clean, "tracking_rms_measured"
    )
    outcome.most("tracking error over that without loss", ratio, 1.5)
    lost = "datagrams_lost_total"
    for role, way in (("world", "downlink"), ("cloud", "uplink")):
        meters.moves(outcome, flight, role, lost, way, since=0.0)
        outcome.least(f"metric {lost} {way}", asks.metric(flight, role, lost, way), 500)
    outcome.least("loss shown", asks.number(flight, "loss_uplink"), 0.25)
    return outcome


def _bursts(seed: int) -> Outcome:
    outcome = Outcome()
    for packets in (5, 20, 50):
        bursts = GilbertElliott(bad_start=1 / 200, bad_end=1 / packets)
        shape: Shape = lambda profile, bursts=bursts: replace(profile, loss=bursts)  # type: ignore[misc]  # noqa: E731
        flight = Flight(
            "criteria.time_limit_s=150", seed=seed, uplink=shape, downlink=shape
        ).fly_mission(150.0)
        asks.safe(outcome, flight)
        if packets < 50:  # else it hardly ever rests on the board for 4 s, and a leg may time out
            asks.done(outcome, flight)
        outcome.true("the mission has ended", flight.mission.ended)
        # Most bursts do nothing: the fault is the first one that is too long.
        since = next(iter(asks.changes_into(flight, GuardState.HOLD)), nan) - AGE_MAX
        meters.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=since)
        text = f"bursts of {packets * 10} ms: "
        outcome.most(f"{text}changes of the guard in any second", asks.busiest_second(flight), 2)
        told, held = asks.number(flight, "hold_count"), len(asks.held(flight))
        outcome.same(f"{text}HOLDs that the report leaves out", held - told, 0)
    return outcome


LINK = (
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


def _names(seed: int) -> Outcome:
    """The peer's name stops to be resolved, then has another address."""
    outcome, said, fails = Outcome(), list[str](), [False]
    addresses = [["10.0.0.7"]]

    def resolve(name: str) -> list[str]:
        if fails[0]:
            raise OSError(-3, "Temporary failure in name resolution")
        return addresses[0]

    peer = PeerName(("cloud", 7400), resolve, said.append)
    first = peer.poll()
    fails[0] = True
    kept = [peer.poll() for _ in range(30)]
    outcome.true("keeps the peer while DNS fails", set(kept) == {first})
    outcome.same("lines in the log about it", len(said) - 1, 1)
    outcome.true("it says so", "cannot be resolved" in said[-1])
    fails[0], addresses[0] = False, ["10.0.0.9"]
    outcome.true("follows the new address", peer.poll() == ("10.0.0.9", 7400))
    outcome.true("it says that too", "was 10.0.0.7" in said[-1])
    outcome.least("shortest pause that it is set to ask again after", PEER_PAUSE[0], 0.1, "s")
    outcome.most("longest pause that it is set to ask again after", PEER_PAUSE[1], 5.0, "s")
    _flown_without_names(outcome, seed)
    return outcome


def _flown_without_names(outcome: Outcome, seed: int) -> None:
    """Fly while no name is resolved; then the cloud moves, and only its name tells where to."""
    at = instant(seed, 2.0, 4.0)
    clean, flight = Flight(seed=seed).fly_mission(), Flight(seed=seed)
    told = _follow(flight, lambda now: "10.0.0.7", at, at + 30.0)
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    meters.moves_among(outcome, "link", told, "dns_errors_total", since=at)
    text = "no name is resolved for 30 s of flight: the same path, bit by bit"
    outcome.true(text, asks.same_path(clean, flight))
    moved, back = at + 5.0, at + 10.0
    flight = Flight("criteria.time_limit_s=120", seed=seed)
    _follow(flight, lambda now: "10.0.0.9" if now >= moved else "10.0.0.7", at, back)
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.least("cloud moves meanwhile: HOLDs", len(asks.held(flight)), 1)
    resumed = asks.resumed_after(flight, back)
    outcome.most("flown again after the name is", resumed, PEER_PAUSE[1] + 1.0, "s")


def _follow(
    flight: Flight, at_home: Callable[[float], str], since: float, until: float
) -> list[Record]:
    """What is sent to cloud goes where its name led to when it was resolved last.

    Args:
        flight: Which.
        at_home: Address of cloud at an instant [s].
        since: From when on no name is resolved [s].
        until: Until when [s].

    Returns:
        What the link tells its metrics of it; more is added while the flight goes on.
    """

    def resolve(name: str) -> list[str]:
        if since <= flight.now < until:
            raise OSError(-3, "Temporary failure in name resolution")
        return [at_home(flight.now)]

    peer, goes = PeerName(("cloud", 7400), resolve, lambda line: None), [""]
    told: list[Record] = []

    def ask(now_ns: int) -> None:
        goes[0] = (peer.poll() or ("", 0))[0]
        told.append(Counted(now_ns, "link", "unresolved", peer.failures))

    def deliver(data: bytes, now_ns: int) -> list[bytes]:
        return [data] if goes[0] == at_home(now_ns * 1e-9) else []

    ask(0)
    for at in np.cumsum(generator(flight.experiment.seed, 78).uniform(*PEER_PAUSE, 240)):
        flight.world.at(float(at), ask)
    flight.cloud.tamper = deliver
    return told


NAMES = (
    Scenario(
        19,
        "dns-failure",
        "the peer's name is not resolved for 30 s, then has a new address",
        "keeps the last peer: the same path, bit by bit; follows the new one within 2 s",
        "none",
        "one line in the log of the link; cloudrc_dns_errors_total",
        _names,
    ),
)


THINGS = ("uplink", "downlink", "cloud", "world", "teleop")
"""In the order in which they freeze: a direction before its sender, so that something is lost."""


class Span(NamedTuple):
    """How long a thing is frozen.

    Attributes:
        start: Instant of virtual time [s].
        duration: [s].
    """

    start: float
    duration: float


def _spans(seed: int) -> dict[str, Span]:
    """Freeze the things one by one, let them go in random order.

    Source: FoundationDB, "Simulation and Testing", swizzle-clogging.
    """
    rng, count = generator(seed, 40), len(THINGS)
    starts = instant(seed) + np.cumsum(rng.uniform(0.1, 1.0, count))
    ends = rng.permutation(starts[-1] + np.cumsum(rng.uniform(0.1, 1.5, count)))
    spans = [Span(float(a), float(b - a)) for a, b in zip(starts, ends, strict=True)]
    return dict(zip(THINGS, spans, strict=True))


def _swizzle(seed: int) -> Outcome:
    outcome, spans = Outcome(), _spans(seed)
    flight = Flight(
        "criteria.time_limit_s=120",
        seed=seed,
        uplink=blackouts(spans["uplink"]),
        downlink=blackouts(spans["downlink"]),
    )
    for name, end in (("cloud", flight.cloud), ("world", flight.world)):
        start, duration = spans[name]
        end.at(start, lambda now_ns, end=end, duration=duration: end.freeze(now_ns, duration))  # type: ignore[misc]
    start, duration = spans["teleop"]
    flight.cloud.at(start, lambda _: flight.desk.kill())
    flight.cloud.at(start + duration, lambda _: flight.desk.start())
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.most("HOLD after", asks.basis_age_at_hold(flight), AGE_MAX, "s")
    _chain(outcome, flight, spans)
    return outcome


def _chain(outcome: Outcome, flight: Flight, spans: dict[str, Span]) -> None:
    """Check that the guard tells why it held, and each thing that it was frozen."""
    asks.causes_told(outcome, flight)
    since, over = spans[THINGS[0]].start, max(sum(span) for span in spans.values())
    for role, *metric in (
        ("cloud", "datagrams_lost_total", "uplink"),
        ("world", "datagrams_lost_total", "downlink"),
        ("cloud", "loop_missed_periods_total"),
        ("world", "world_slip_seconds_total"),
        ("world", "guard_transitions_total", "hold"),
    ):
        meters.moves(outcome, flight, role, *metric, since=since, over=over)
    for end, records in (("cloud", flight.of_cloud), ("world", flight.of_world)):
        outcome.least(f"times that {end} tells: late", len(asks.told(records, "late")), 1)
    restarted = [entry for entry in flight.desk.entries if entry.get("event") == "restarted"]
    outcome.least("the journal tells: restarted", len(restarted), 1)


SWIZZLE = (
    Scenario(
        40,
        "swizzle-clog",
        "uplink, downlink, cloud, world and teleop freeze one by one and return in random order",
        "always a safe state; the mission goes on",
        "as above",
        "guard HOLD with its cause, cloudrc_guard_transitions_total; of each that was frozen: "
        "fault 'late' of both ends, "
        "cloudrc_datagrams_lost_total both ways, cloudrc_loop_missed_periods_total, "
        "cloudrc_world_slip_seconds_total, mission restarted",
        _swizzle,
    ),
)


SCENARIOS = (
    *LINK,
    *NAMES,
    *SWIZZLE,
)
