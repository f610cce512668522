"""Faults F13, F15, F17, F25 and F40: processes are killed or frozen, or a second cloud appears."""

from __future__ import annotations

from functools import partial
from math import hypot, nan

import numpy as np

from cloudrc.faults import measures
from cloudrc.faults.flight import Flight, silent
from cloudrc.faults.measures import fly_safely, refused
from cloudrc.faults.models import EndpointGroup
from cloudrc.faults.scenario import Outcome, generator, scenario
from cloudrc.records import CommandApplied, Fault
from cloudrc.tunnel.handshake import BUSY_TEXT


@scenario(
    13,
    "cloud-killed",
    injects="SIGKILL of the cloud process; a new process starts 0.8 s later",
    expects="HOLD within 252 ms; new commands in <= 2 s; the mission continues at its waypoint",
)
def _cloud_killed(outcome: Outcome, seed: int) -> None:
    at, down = measures.instant(seed), 0.8
    flight = Flight(seed=seed)
    flight.cloud.at(at, partial(flight.cloud.restart, down=down))
    fly_safely(outcome, flight)
    measures.held_in_time(outcome, flight)
    commands = [r.stamp_ns * 1e-9 - at for r in flight.of_world if isinstance(r, CommandApplied)]
    again = min((t for t in commands if t > down), default=nan)
    outcome.most("the new process commands after", again, 2.0, "s")
    outcome.most("TRACK again after its start", measures.resumed_after(flight, at + down), 1.0, "s")
    outcome.least("epochs opened", len(measures.epochs(flight)), 3)


@scenario(
    15,
    "cloud-paused",
    injects="SIGSTOP of the cloud process for 5 s",
    expects="HOLD; world applies no command that is too old",
)
def _cloud_paused(outcome: Outcome, seed: int) -> None:
    at = measures.instant(seed)
    flight = Flight(seed=seed)
    flight.cloud.at(at, partial(flight.cloud.freeze, duration=5.0))
    fly_safely(outcome, flight)
    measures.held_in_time(outcome, flight)
    applied = [r for r in flight.of_world if isinstance(r, CommandApplied)]
    old = [r for r in applied if r.stamp_ns - r.basis_stamp_ns > measures.AGE_MAX * 1e9]
    outcome.same("commands applied that were too old", len(old), 0)


@scenario(
    17,
    "world-restarted",
    injects="the world pod restarts within 2 s",
    expects="the robot is at its spawn on the ground, and stays there; a new epoch; world rejects "
    "commands of the old epoch",
)
def _world_restarted(outcome: Outcome, seed: int) -> None:
    at = measures.instant(seed)
    flight = Flight(seed=seed)
    flight.world.at(at, partial(flight.world.restart, down=2.0))
    flight.fly(at + 12.0)
    measures.safe(outcome, flight)
    after = [c for c in flight.changes if c.stamp_ns * 1e-9 > at]
    outcome.same("changes of the guard after the restart", len(after), 0)
    path = [r for r in flight.trajectory() if r.stamp_ns * 1e-9 > at]
    moved = max((hypot(*r.odometry.velocity) for r in path), default=nan)
    outcome.most("speed on the ground", moved, 0.01, "m/s")
    raised = measures.drift(flight, at, flight.now)
    outcome.most("distance from its place after the restart", raised, 0.01, "m")
    outcome.true("mission failed", flight.mission.state == "failed")
    coded = "world_restarted" in str(flight.mission.verdict)
    outcome.true("with the code world_restarted", coded)
    refused(outcome, flight, "old_epoch")  # commands for the old world


@scenario(
    25,
    "two-clouds",
    injects="a second cloud with the same key; later the first one leaves",
    expects="the first cloud keeps the session until it leaves; then HOLD, and the second cloud "
    "gets a higher epoch; commands of both never mix",
)
def _two_clouds(outcome: Outcome, seed: int) -> None:
    at = measures.instant(seed, 4.0, 12.0)
    flight = Flight(seed=seed, second=at)
    group = flight.cloud.inner
    assert isinstance(group, EndpointGroup)
    flight.fly(at + 5.0)
    opened = max(measures.epochs(flight), default=-1)
    outcome.same("epochs while both clouds run", opened, 2)
    flight.fly(at + 6.0)
    outcome.same("HOLDs while both clouds run", len(measures.held(flight)), 0)
    faults = [record for record in flight.of_cloud if isinstance(record, Fault)]
    outcome.same("faults that the first cloud reports", len(faults), 0)
    group.members = group.members[1:]  # the first leaves
    flight.fly(at + 14.0)
    measures.safe(outcome, flight)
    refused(outcome, flight, "busy")
    told = measures.told(group.others, "busy")
    outcome.true("the second reports once why it waits", [r.text for r in told] == [BUSY_TEXT])
    said = min((r.stamp_ns * 1e-9 for r in told), default=nan)
    outcome.most("the second cloud reports it after", said - at, 1.0, "s")
    measures.held_in_time(outcome, flight, "HOLD after the first cloud has left")
    later = [epoch for epoch in measures.epochs(flight) if epoch > 2]
    outcome.true("the second cloud then gets a higher epoch", bool(later))


@scenario(
    40,
    "swizzle-clog",
    injects="uplink, downlink, cloud, world and teleop freeze one by one and return in random "
    "order",
    expects="always a safe state; the mission continues",
)
def _swizzle(outcome: Outcome, seed: int) -> None:
    """Block both directions of the link, then stop the processes; resume all in random order.

    Source: FoundationDB, "Simulation and Testing", swizzle-clogging.
    """
    rng = generator(seed, 40)
    starts = measures.instant(seed) + np.cumsum(rng.uniform(0.1, 1.0, 5))
    ends = rng.permutation(starts[-1] + np.cumsum(rng.uniform(0.1, 1.5, 5)))
    spans = zip(starts.tolist(), (ends - starts).tolist(), strict=True)
    uplink, downlink, cloud, world, teleop = spans
    limit, links = "criteria.time_limit_s=120", (silent(*uplink), silent(*downlink))
    flight = Flight(limit, seed=seed, uplink=links[0], downlink=links[1])
    for process, (start, duration) in ((flight.cloud, cloud), (flight.world, world)):
        process.at(start, partial(process.freeze, duration=duration))
    flight.cloud.at(teleop[0], flight.teleop.kill)
    flight.cloud.at(sum(teleop), flight.teleop.start)
    fly_safely(outcome, flight)
    measures.held_in_time(outcome, flight)
    for end, records in (("cloud", flight.of_cloud), ("world", flight.of_world)):
        outcome.least(f"times that {end} reports: late", len(measures.told(records, "late")), 1)
    restarted = measures.events_of_missions(flight, "restarted")
    outcome.least("events restarted in teleop's log", len(restarted), 1)
