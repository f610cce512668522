"""Faults with real processes, signals and sockets; times are those of this machine."""

from __future__ import annotations

import signal
import time

import numpy as np

from cloudrc.faults.real_processes import Processes, release, throttle
from cloudrc.faults.scenario import Mode, Outcome, Scenario
from cloudrc.messages import GuardState

AGE_MAX = 0.252
"""`command_age_max` and one tick [s]."""
PERIOD = 0.2
"""Between two looks at whether something has come about [s]."""
WORKING = 3
"""Waypoints reached before something happens: the robot is then in the pipes."""


def pause(duration: float) -> None:
    """Let real time pass.

    Args:
        duration: How much [s].
    """
    time.sleep(duration)


def _guard(run: Processes) -> list[tuple[float, str]]:
    """When the guard went into which state, on world's clock [s]."""
    table = run.table("/guard")
    states = [GuardState(int(state)).name for state in table["state"]]
    return list(zip((table["stamp_ns"] * 1e-9).tolist(), states, strict=True))


def _age_at_hold(run: Processes) -> float:
    """Largest age of the newest applied basis when the guard went to HOLD in the mission [s]."""
    applied, guard = run.table("/command_applied"), run.table("/guard")
    ages = [0.0]
    for stamp_ns, state, cause in zip(
        guard["stamp_ns"].tolist(), guard["state"].tolist(), guard["cause"].tolist(), strict=True
    ):
        before = applied["basis_stamp_ns"][applied["stamp_ns"] <= stamp_ns]
        if GuardState(int(state)) is GuardState.HOLD and "age" in cause and len(before):
            ages.append((stamp_ns - int(before.max())) * 1e-9)
    return max(ages)


def finish(outcome: Outcome, run: Processes) -> None:
    """Check that the mission is done, each waypoint once, no pipe touched."""
    run.over()
    time.sleep(0.6)  # the recorder's flush
    events = run.events()
    outcome.true("mission done", "done" in events)
    outcome.same("waypoints reached", events.count("reached"), 7)
    bodies = run.table("/contact")["body"].tolist()
    outcome.same("pipe contacts", sum(body.startswith("pipe") for body in bodies), 0)


def _cloud_killed(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        sessions = run.scrape()["cloudrc_session_epoch"]
        killed = run.kill("cloud")
        run.start("cloud")
        run.until("a new session", lambda: run.scrape()["cloudrc_session_epoch"] > sessions)
        outcome.most("a new session after", time.monotonic() - killed, 3.0, "s")
        finish(outcome, run)
        outcome.most("HOLD after", _age_at_hold(run), AGE_MAX + 1e-9, "s")
        outcome.least("HOLDs", sum(state == "HOLD" for _, state in _guard(run)), 1)
    return outcome


def _cloud_paused(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        run.send("cloud", signal.SIGSTOP)
        time.sleep(3.0)
        run.send("cloud", signal.SIGCONT)
        finish(outcome, run)
        outcome.most("HOLD after", _age_at_hold(run), AGE_MAX + 1e-9, "s")
        applied = run.table("/command_applied")
        ages = (applied["stamp_ns"] - applied["basis_stamp_ns"]) * 1e-9
        outcome.most("oldest basis applied", float(ages.max()), AGE_MAX, "s")
    return outcome


def _cloud_throttled(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(2)
        pid = run.running["cloud"].pid
        group = throttle(pid, 0.3)
        if group is None:
            outcome.skipped = "cgroups cannot be made here; run as root"
            return outcome
        try:
            time.sleep(5.0)
        finally:
            release(group, pid)
        finish(outcome, run)
        outcome.most("HOLD, if any, after", _age_at_hold(run), AGE_MAX + 1e-9, "s")
    return outcome


def _world_killed(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        run.kill("world")
        run.start("world")
        run.over()
        outcome.true("mission failed: world_restarted", "world_restarted" in run.events())
        time.sleep(3.0)
        states = {state for _, state in _guard(run)}
        outcome.true("the new world stays on the ground", states <= {"GROUND"})
        _, recovery = run.recording("world", 0)
        outcome.least("the killed world's recording, kept", recovery.share, 0.9)
        epochs = run.table("/session")["epoch"].tolist()
        outcome.least("epochs go on", min(epochs, default=0), 3)
    return outcome


def _world_paused(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(2)
        run.send("world", signal.SIGSTOP)
        time.sleep(0.2)
        run.send("world", signal.SIGCONT)
        finish(outcome, run)
        stamps = np.diff(run.table("/ground_truth")["stamp_ns"])
        outcome.true("no tick is skipped", bool((stamps == 10_000_000).all()))
        counters = run.table("/command_applied")
        pairs = list(zip(counters["epoch"].tolist(), counters["counter"].tolist(), strict=True))
        outcome.true("commands applied in order, none twice", pairs == sorted(set(pairs)))
    return outcome


def holds(run: Processes, since: float, until: float) -> int:
    """Count the HOLDs for want of fresh commands.

    Args:
        run: Whose.
        since: First instant [s], monotonic clock.
        until: Last instant [s].
    """
    table = run.table("/guard")
    events = zip(
        (table["stamp_ns"] * 1e-9).tolist(),
        table["state"].tolist(),
        table["cause"].tolist(),
        strict=True,
    )
    return sum(
        since <= time <= until and GuardState(int(state)) is GuardState.HOLD and "age" in cause
        for time, state, cause in events
    )


def _shutdown(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        outcome.most("teleop ends after", run.end("teleop"), 2.0, "s")
        outcome.same("its exit code", run.running["teleop"].returncode, 0)
        outcome.most("cloud ends after", run.end("cloud"), 2.0, "s")
        outcome.same("its exit code", run.running["cloud"].returncode, 0)
        outcome.true("the journal says so", "paused" in run.events())
        run.start("teleop")
        run.start("cloud")
        finish(outcome, run)
    return outcome


REAL: Mode = "real"
SCENARIOS = (
    Scenario(
        13,
        "cloud-killed",
        "SIGKILL of the cloud process in the pipes, a new one at once",
        "HOLD by 252 ms, a new session, the mission goes on",
        "cloud's memory",
        "cloudrc_session_epoch",
        _cloud_killed,
        REAL,
    ),
    Scenario(
        15,
        "cloud-paused",
        "SIGSTOP of the cloud process for 3 s",
        "HOLD; nothing old is applied; the mission goes on",
        "none",
        "guard HOLD",
        _cloud_paused,
        REAL,
    ),
    Scenario(
        16,
        "cloud-throttled",
        "a cgroup gives the cloud process 30 % of a processor for 5 s",
        "stalls ride inside the age limit, else HOLD",
        "none",
        "cloudrc_loop_missed_periods_total",
        _cloud_throttled,
        REAL,
    ),
    Scenario(
        17,
        "world-restarted",
        "SIGKILL of the world process in the pipes, a new one at once",
        "the new world stays on the ground, epochs go on",
        "the flight in progress",
        "mission failed: world_restarted",
        _world_killed,
        REAL,
    ),
    Scenario(
        33,
        "shutdown",
        "SIGTERM of teleop and cloud in a mission, then new ones",
        "both end in 2 s with exit code 0; the journal is written; the mission goes on",
        "none",
        "paused by shutdown",
        _shutdown,
        REAL,
    ),
    Scenario(
        39,
        "world-paused",
        "SIGSTOP of the world process for 200 ms",
        "no tick is skipped, no command applied twice",
        "none",
        "cloudrc_world_slip_seconds_total",
        _world_paused,
        REAL,
    ),
)
