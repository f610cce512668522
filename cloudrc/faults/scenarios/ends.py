"""Faults of the two ends: killed, evicted, paused, throttled, restarted, overloaded."""

from __future__ import annotations

import re
from itertools import pairwise
from math import hypot, nan

from cloudrc.faults import asks
from cloudrc.faults import asks as meters
from cloudrc.faults.flight import Flight
from cloudrc.faults.held import AGE_MAX
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.faults.scenarios.link import instant
from cloudrc.messages import GuardState
from cloudrc.records import CommandApplied, Fault, GroundTruth, Lateness


def _cloud_killed(seed: int) -> Outcome:
    outcome, at, down = Outcome(), instant(seed), 0.8
    flight = Flight(seed=seed)
    flight.cloud.at(at, lambda now_ns: flight.kill_cloud(now_ns, down))
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.most("HOLD after", asks.basis_age_at_hold(flight), AGE_MAX, "s")
    commands = [r.stamp_ns * 1e-9 - at for r in flight.of_world if isinstance(r, CommandApplied)]
    again = min((t for t in commands if t > down), default=nan)
    outcome.most("the new process commands after", again, 2.0, "s")
    outcome.most("TRACK again after its start", asks.resumed_after(flight, at + down), 1.0, "s")
    opened = asks.epochs(flight)
    outcome.true("a new epoch, higher than all before", opened == sorted(set(opened)))
    meters.moves(outcome, flight, "world", "session_epoch", since=at)
    outcome.least("epochs opened", len(opened), 3)
    return outcome


def _cloud_evicted(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed)
    flight = Flight(seed=seed)
    flight.cloud.at(at, lambda now_ns: flight.kill_cloud_pod(now_ns, 5.0))
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.most("away for 5 s: HOLD after", asks.basis_age_at_hold(flight), AGE_MAX, "s")
    outcome.least("the journal tells: resumed", len(flight.events("resumed")), 1)
    meters.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=at)
    outcome.add(_evicted_for_long(seed))
    return outcome


def _evicted_for_long(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed)
    flight = Flight("criteria.time_limit_s=900", seed=seed)
    flight.cloud.at(at, lambda now_ns: flight.kill_cloud_pod(now_ns, 360.0))
    flight.fly(at + 370.0)
    asks.safe(outcome, flight)
    held = next(iter(asks.changes_into(flight, GuardState.HOLD)), nan)
    landed = next(iter(asks.changes_into(flight, GuardState.LAND)), nan)
    outcome.most("away for 6 min: LAND after HOLD", landed - held, 60.01, "s")
    outcome.least("away for 6 min: LAND not before", landed - held, 60.0, "s")
    asks.landing_told(outcome, flight)
    again = [time for time in asks.changes_into(flight, GuardState.TRACK) if time > landed]
    outcome.same("flown again without the operator", len(again), 0)
    return outcome


def _cloud_paused(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed)
    flight = Flight(seed=seed, apart=True)
    flight.cloud.at(at, lambda now_ns: flight.cloud.freeze(now_ns, 5.0))
    shown = asks.look(flight, at + 4.0)
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.most("HOLD after", asks.basis_age_at_hold(flight), AGE_MAX, "s")
    asks.silence_told(outcome, shown, 4.0, cloud=False, what="cloud stalled")
    asks.causes_told(outcome, flight)
    applied = [r for r in flight.of_world if isinstance(r, CommandApplied)]
    old = [r for r in applied if r.stamp_ns - r.basis_stamp_ns > AGE_MAX * 1e9]
    outcome.same("commands applied that were too old", len(old), 0)
    meters.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=at)
    missed_by = ("cloud", "loop_missed_periods_total")
    meters.moves(outcome, flight, *missed_by, since=at, over=at + 5.0)
    missed = asks.metric(flight, "cloud", "loop_missed_periods_total")
    outcome.least("metric loop_missed_periods_total at the end", missed, 490)
    return outcome


def _throttled(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed, 4.0, 8.0)
    for quota in (0.5, 0.3, 0.1):
        flight = Flight("link.profile=paper-p1", seed=seed)
        flight.cloud.throttle(at, 10.0, quota)
        flight.fly_mission()
        asks.safe(outcome, flight)
        asks.done(outcome, flight)
        what = f"quota of {quota:.0%}"
        outcome.same(f"{what}: HOLDs", len(asks.held(flight)), 0)
        meters.moves(outcome, flight, "cloud", "loop_missed_periods_total", since=at)
        missed = flight.count("missed_periods", "cloud")
        outcome.least(f"{what}: missed periods counted", missed, 100)
        meters.moves(outcome, flight, "cloud", "loop_lateness_seconds", since=at)
        told = [r.stamp_ns * 1e-9 - at for r in asks.told(flight.of_cloud, "late")]
        outcome.most(f"{what}: it says that it is late after", min(told, default=nan), 2.0, "s")
    return outcome


def _world_restarted(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed)
    flight = Flight(seed=seed)
    flight.world.at(at, lambda now_ns: flight.kill_world(now_ns, 2.0))
    flight.fly(at + 12.0)
    asks.safe(outcome, flight)
    after = [c for c in flight.changes if c.stamp_ns * 1e-9 > at]
    outcome.same("changes of the guard after it", len(after), 0)
    path = [r for r in flight.trajectory() if r.stamp_ns * 1e-9 > at]
    moved = max((hypot(*r.odometry.velocity) for r in path), default=nan)
    outcome.most("speed on the ground", moved, 0.01, "m/s")
    raised = asks.drift(flight, at, flight.now)
    outcome.most("way from where it stood up", raised, 0.01, "m")
    verdict = str(flight.mission.verdict)
    outcome.true("mission failed", flight.mission.state == "failed")
    outcome.true("with the code world_restarted", "world_restarted" in verdict)
    opened = asks.epochs(flight)
    outcome.true("a new epoch, higher than all before", opened == sorted(set(opened)))
    back = at + 2.0
    # What cloud still says to the world before.
    meters.moves(outcome, flight, "world", "datagrams_total", "downlink", "old_epoch", since=back)
    meters.moves(outcome, flight, "world", "session_epoch", since=back)
    meters.moves(outcome, flight, "cloud", "missions_total", "world_restarted", since=back)
    return outcome


def _world_overloaded(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed, 4.0, 8.0)
    flight = Flight("criteria.time_limit_s=120", seed=seed)
    for n in range(100):
        flight.world.at(at + 0.1 * n, lambda now_ns: flight.world.freeze(now_ns, 0.09))
    flight.fly_mission()
    asks.safe(outcome, flight)
    outcome.true("simulated time has no gap", _gapless(flight.trajectory()))
    slip = flight.world.inner.slip_ns * 1e-9  # type: ignore[union-attr]
    outcome.least("simulated time slows: slip", slip, 3.0, "s")
    meters.moves(outcome, flight, "world", "world_slip_seconds_total", since=at)
    seen = meters.seen_by(flight, "world", at + meters.SOON)
    factor = meters.reading("world", seen, "real_time_factor")
    outcome.most("metric real_time_factor", factor, 0.95)
    _slow_told(outcome, flight, at)
    outcome.true("mission done", flight.mission.state == "done")
    return outcome


def _world_paused(seed: int) -> Outcome:
    outcome, at = Outcome(), instant(seed)
    flight = Flight("link.profile=paper-p1", seed=seed)
    flight.world.at(at, lambda now_ns: flight.world.freeze(now_ns, 0.2))
    flight.fly_mission()
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.true("simulated time has no gap", _gapless(flight.trajectory()))
    outcome.true("commands applied in order, none twice", asks.applied_in_order(flight))
    slip = flight.world.inner.slip_ns * 1e-9  # type: ignore[union-attr]
    outcome.most("slip", slip, 0.2, "s")
    outcome.least("slip told", slip, 0.1, "s")
    meters.moves(outcome, flight, "world", "world_slip_seconds_total", since=at)
    meters.moves(outcome, flight, "world", "loop_lateness_seconds", since=at)
    _slow_told(outcome, flight, at)
    return outcome


def _slow_told(outcome: Outcome, flight: Flight, at: float) -> None:
    """Check that world has said once, and soon after an instant [s], how slow it was."""
    told = asks.told(flight.of_world, "late")
    outcome.same("faults told: late", len(told), 1)
    after = min((fault.stamp_ns * 1e-9 - at for fault in told), default=nan)
    outcome.least("not before it happens: after", after, 0.0, "s")
    outcome.most("by world's clock within", after, 2.0, "s")
    wrong = max((abs(_told_factor(f) - _factor(flight, f.stamp_ns)) for f in told), default=nan)
    outcome.most("the real-time factor that it tells is wrong by", wrong, 0.05)


def _told_factor(fault: Fault) -> float:
    told = re.match(r"real-time factor (\d\.\d\d) over ", fault.text)
    return float(told[1]) if told else nan


def _factor(flight: Flight, stamp_ns: int) -> float:
    """Real-time factor of the second before an instant [ns, world's clock], by world's wakes."""
    wakes = [r for r in flight.of_world if isinstance(r, Lateness)]
    ends_ns = (stamp_ns - 1_000_000_000, stamp_ns)
    before_ns, slip_ns = (
        max((r.slip_ns for r in wakes if r.stamp_ns <= end_ns), default=0) for end_ns in ends_ns
    )
    return 1.0 / (1.0 + (slip_ns - before_ns) * 1e-9)


def _gapless(path: list[GroundTruth]) -> bool:
    stamps = [record.stamp_ns for record in path]
    return all(b - a == 10_000_000 for a, b in pairwise(stamps))


SCENARIOS = (
    Scenario(
        13,
        "cloud-killed",
        "SIGKILL of the cloud process, a new one 0.8 s later",
        "HOLD by 252 ms; the new process commands in <= 2 s; the same waypoint goes on",
        "cloud's memory only",
        "a new session, cloudrc_session_epoch",
        _cloud_killed,
    ),
    Scenario(
        14,
        "cloud-evicted",
        "the cloud pod, teleop included, is away for 5 s and for 6 min",
        "HOLD, resumes from the journal; after 60 s LAND, latched",
        "as F3",
        "mission resumed, or why it failed; cloudrc_guard_transitions_total",
        _cloud_evicted,
    ),
    Scenario(
        15,
        "cloud-paused",
        "SIGSTOP of the cloud process for 5 s",
        "HOLD; of what it computed before nothing is applied",
        "none",
        "guard HOLD with its cause; in the status: cloud not heard, nor the robot; "
        "cloudrc_guard_transitions_total, then cloudrc_loop_missed_periods_total",
        _cloud_paused,
    ),
    Scenario(
        16,
        "cloud-throttled",
        "CPU quota of 50, 30 and 10 % of a 100 ms period for 10 s",
        "stalls of up to 90 ms ride inside the age limit",
        "none",
        "fault 'late' in cloud, cloudrc_loop_lateness_seconds, cloudrc_loop_missed_periods_total",
        _throttled,
    ),
    Scenario(
        17,
        "world-restarted",
        "the world pod restarts within 2 s",
        "back on the ground, never airborne without power; a new epoch, commands of the old one "
        "are refused; nothing resumes alone",
        "the flight in progress",
        "mission failed: world_restarted; cloudrc_missions_total, cloudrc_session_epoch",
        _world_restarted,
    ),
    Scenario(
        18,
        "world-overloaded",
        "the world gets less CPU than real time needs, for 10 s",
        "simulated time slows, no guard tick is skipped",
        "none",
        "fault 'late' in world: real-time factor 0.72 ...; cloudrc_world_slip_seconds_total, "
        "cloudrc_real_time_factor",
        _world_overloaded,
    ),
    Scenario(
        39,
        "world-paused",
        "the world process stands still for 200 ms",
        "it catches up in simulated time, no command is applied twice",
        "none",
        "fault 'late' in world; cloudrc_world_slip_seconds_total, cloudrc_loop_lateness_seconds",
        _world_paused,
    ),
)
