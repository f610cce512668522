"""Faults F13, F15 and F17: cloud is killed or frozen, world restarts."""

from __future__ import annotations

from math import hypot, nan

from cloudrc.faults import measures
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.records import CommandApplied


def _cloud_killed(seed: int) -> Outcome:
    outcome, at, down = Outcome(), measures.instant(seed), 0.8
    flight = Flight(seed=seed)
    flight.cloud.at(at, lambda now_ns: flight.kill_cloud(now_ns, down))
    flight.fly_mission()
    measures.safe_and_done(outcome, flight)
    measures.held_in_time(outcome, flight)
    commands = [r.stamp_ns * 1e-9 - at for r in flight.of_world if isinstance(r, CommandApplied)]
    again = min((t for t in commands if t > down), default=nan)
    outcome.most("the new process commands after", again, 2.0, "s")
    outcome.most("TRACK again after its start", measures.resumed_after(flight, at + down), 1.0, "s")
    opened = measures.epochs(flight)
    outcome.true("a new epoch, higher than all before", opened == sorted(set(opened)))
    measures.moves(outcome, flight, "world", "session_epoch", since=at)
    outcome.least("epochs opened", len(opened), 3)
    return outcome


def _cloud_paused(seed: int) -> Outcome:
    outcome, at = Outcome(), measures.instant(seed)
    flight = Flight(seed=seed, separate=True)
    flight.cloud.at(at, lambda now_ns: flight.cloud.freeze(now_ns, 5.0))
    shown = measures.look(flight, at + 4.0)
    flight.fly_mission()
    measures.safe_and_done(outcome, flight)
    measures.held_in_time(outcome, flight)
    measures.silence_told(outcome, shown, 4.0, cloud=False, what="cloud stalled")
    measures.causes_told(outcome, flight)
    applied = [r for r in flight.of_world if isinstance(r, CommandApplied)]
    old = [r for r in applied if r.stamp_ns - r.basis_stamp_ns > measures.AGE_MAX * 1e9]
    outcome.same("commands applied that were too old", len(old), 0)
    measures.moves(outcome, flight, "world", "guard_transitions_total", "hold", since=at)
    missed_by = ("cloud", "loop_missed_periods_total")
    measures.moves(outcome, flight, *missed_by, since=at, over=at + 5.0)
    missed = measures.metric(flight, "cloud", "loop_missed_periods_total")
    outcome.least("metric loop_missed_periods_total at the end", missed, 490)
    return outcome


def _world_restarted(seed: int) -> Outcome:
    outcome, at = Outcome(), measures.instant(seed)
    flight = Flight(seed=seed)
    flight.world.at(at, lambda now_ns: flight.kill_world(now_ns, 2.0))
    flight.fly(at + 12.0)
    measures.safe(outcome, flight)
    after = [c for c in flight.changes if c.stamp_ns * 1e-9 > at]
    outcome.same("changes of the guard after it", len(after), 0)
    path = [r for r in flight.trajectory() if r.stamp_ns * 1e-9 > at]
    moved = max((hypot(*r.odometry.velocity) for r in path), default=nan)
    outcome.most("speed on the ground", moved, 0.01, "m/s")
    raised = measures.drift(flight, at, flight.now)
    outcome.most("way from where it stood up", raised, 0.01, "m")
    verdict = str(flight.mission.verdict)
    outcome.true("mission failed", flight.mission.state == "failed")
    outcome.true("with the code world_restarted", "world_restarted" in verdict)
    opened = measures.epochs(flight)
    outcome.true("a new epoch, higher than all before", opened == sorted(set(opened)))
    back = at + 2.0
    # What cloud still says to the world before.
    measures.moves(outcome, flight, "world", "datagrams_total", "downlink", "old_epoch", since=back)
    measures.moves(outcome, flight, "world", "session_epoch", since=back)
    measures.moves(outcome, flight, "cloud", "missions_total", "world_restarted", since=back)
    return outcome


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
        17,
        "world-restarted",
        "the world pod restarts within 2 s",
        "back on the ground, never airborne without power; a new epoch, commands of the old one "
        "are refused; nothing resumes alone",
        "the flight in progress",
        "mission failed: world_restarted; cloudrc_missions_total, cloudrc_session_epoch",
        _world_restarted,
    ),
)
