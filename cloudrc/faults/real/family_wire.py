"""Faults with real sockets and files: a flood of garbage, a killed recorder."""

from __future__ import annotations

import time
from math import nan

from cloudrc.faults.held import holds
from cloudrc.faults.real.family_processes import REAL, WORKING, finish
from cloudrc.faults.real.processes import Processes, flood
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.faults.toll import REFUSED


def _garbage(seed: int) -> Outcome:
    outcome, seconds = Outcome(), 20
    # The robot stays for as long at its first waypoint, so that the mission outlives the flood.
    with Processes("mission.waypoints.1.dwell_s=15", "criteria.time_limit_s=120", seed=seed) as run:
        run.reached(1)
        began, since = run.scrape(), time.monotonic()
        attacker = flood(run.ports["world"], 10_000, seconds)
        sent = int(attacker.communicate(timeout=4 * seconds)[0])
        ended, until = run.scrape(), time.monotonic()
        lost = 'cloudrc_datagrams_lost_total{direction="downlink"}'
        outcome.least("garbage sent per second", sent / seconds, 9_000)
        outcome.same("honest datagrams lost", ended.get(lost, 0) - began.get(lost, 0), 0)
        risen = {k: v - began.get(k, 0) for k, v in ended.items() if "datagrams_total" in k}
        refused = {name: _of(risen, name) for name in REFUSED}
        outcome.least("garbage counted as refused, share", sum(refused.values()) / sent, 0.9)
        outcome.least("of it right in form, refused by its tag, share", refused["tag"] / sent, 0.05)
        flown = finish(outcome, run)
        outcome.same("HOLDs meanwhile", holds(flown, since, until), 0)
    return outcome


def _of(readings: dict[str, float], name: str) -> float:
    return sum(v for k, v in readings.items() if f'outcome="{name}"' in k)


def _recorder_killed(seed: int) -> Outcome:
    """The world process records; it is killed while it tells what it has recorded."""
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        shown = run.scrape()
        slip = shown["cloudrc_world_slip_seconds_total"]
        before_ns = time.monotonic_ns()
        run.kill("world")
        recording, recovery = run.recording("world")
        # World's clock follows the machine's monotonic one, and lags it by its slip.
        last_ns = int(recording["/ground_truth"]["stamp_ns"][-1])
        outcome.most("stretch lost", (before_ns - last_ns) * 1e-9 - slip, 0.5, "s")
        age = shown.get("cloudrc_recorder_sync_age_seconds", nan)
        outcome.most("metric recorder_sync_age_seconds before", age, 1.0, "s")
        outcome.least("kept, share of the bytes", recovery.share, 0.99)
        outcome.same("damaged chunks", recovery.dropped.get("chunks", 0), 0)
    return outcome


SCENARIOS = (
    Scenario(
        20,
        "garbage-flood",
        "10,000 datagrams of garbage per second at the world's port for 20 s, a third of "
        "it as long as a command and with its head",
        "no honest datagram is lost, no HOLD",
        "none",
        "cloudrc_datagrams_total by outcome",
        _garbage,
        REAL,
    ),
    Scenario(
        30,
        "recorder-killed",
        "SIGKILL of the world process, which records",
        "the rest of the recording recovers",
        "at most 0.5 s",
        "cloudrc recover; before, cloudrc_recorder_sync_age_seconds",
        _recorder_killed,
        REAL,
    ),
)
