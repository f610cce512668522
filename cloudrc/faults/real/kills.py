"""Faults with real processes, signals and sockets; times are those of this machine.

Faults of a mission's Job, whose pod is a process of its own that speaks with teleop's API.
"""

from __future__ import annotations

import re
import signal
import time
from math import inf

import numpy as np

from cloudrc.cli.client import Api, UnreachableError
from cloudrc.faults.held import AGE_MAX, age_at_hold, holds
from cloudrc.faults.real.processes import LIMIT, Processes, release, throttle, throttled
from cloudrc.faults.scenario import Mode, Outcome, Scenario
from cloudrc.messages import Cause, GuardState
from cloudrc.record.columns import Recording

WORKING = 3
"""Waypoints reached before something happens: the robot is then in the pipes."""


def finish(outcome: Outcome, run: Processes) -> Recording:
    """Check that the mission is done, each waypoint once, no pipe touched.

    Returns:
        World's recording.
    """
    run.over()
    time.sleep(0.6)  # the recorder's flush
    events = run.events()
    outcome.true("mission done", "done" in events)
    outcome.same("waypoints reached", events.count("reached"), 7)
    flown, _ = run.recording("world")
    bodies = flown["/contact"]["body"].tolist()
    outcome.same("pipe contacts", sum(body.startswith("pipe") for body in bodies), 0)
    return flown


def _cloud_killed(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        sessions = run.scrape()["cloudrc_session_epoch"]
        killed = run.kill("cloud")
        run.start("cloud")
        run.until("a new session", lambda: run.scrape()["cloudrc_session_epoch"] > sessions)
        outcome.most("a new session after", time.monotonic() - killed, 3.0, "s")
        slip = run.slip()
        flown = finish(outcome, run)
        outcome.most("HOLD after", age_at_hold(flown), AGE_MAX, "s")
        outcome.least("HOLDs", holds(flown), 1)
        applied = flown["/command_applied"]
        by_new = applied["stamp_ns"][applied["epoch"] > sessions] * 1e-9
        again = float(by_new.min(initial=inf)) + slip - killed
        outcome.most("the new process commands after", again, 2.0, "s")
    return outcome


def _cloud_paused(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        run.send("cloud", signal.SIGSTOP)
        time.sleep(3.0)
        run.send("cloud", signal.SIGCONT)
        flown = finish(outcome, run)
        outcome.most("HOLD after", age_at_hold(flown), AGE_MAX, "s")
        outcome.least("HOLDs", holds(flown), 1)
        applied = flown["/command_applied"]
        ages = (applied["stamp_ns"] - applied["basis_stamp_ns"]) * 1e-9
        outcome.most("oldest basis applied", float(ages.max()), AGE_MAX, "s")
    return outcome


def _cloud_throttled(seed: int) -> Outcome:
    """First short stalls, which ride inside the age limit; then ones of nearly a second."""
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(2)
        for period in (0.1, 1.0):
            since = time.monotonic() - run.slip()
            periods = _throttled(run, period)
            if periods is None:
                outcome.skipped = "cgroups cannot be made here; run as root"
                return outcome
            outcome.least(f"periods of {period:g} s whose 2 ms were used up", periods, 1)
        flown = finish(outcome, run)
        outcome.least("HOLDs amid the long stalls", holds(flown, since), 1)
        outcome.most("HOLD after", age_at_hold(flown), AGE_MAX, "s")
    return outcome


def _throttled(run: Processes, period: float) -> int | None:
    """Throttle cloud for 5 s; count the periods whose share it has used up; None if forbidden."""
    pid = run.running["cloud"].pid
    group = throttle(pid, 0.002 / period, period)
    if group is None:
        return None
    try:
        time.sleep(5.0)
        return throttled(group)
    finally:
        release(group, pid)


def _world_killed(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        run.kill("world")
        run.start("world")
        run.over()
        outcome.true("mission failed: world_restarted", "world_restarted" in run.events())
        time.sleep(3.0)
        flown, _ = run.recording("world")
        states = set(flown["/guard"]["state"].tolist())
        outcome.true("the new world stays on the ground", states <= {GuardState.GROUND})
        _, recovery = run.recording("world", 0)
        outcome.least("the killed world's recording, kept", recovery.share, 0.9)
        epochs = flown["/session"]["epoch"].tolist()
        outcome.least("epochs go on", min(epochs, default=0), 3)
    return outcome


def _world_paused(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(2)
        stopped_ns = time.monotonic_ns()
        run.send("world", signal.SIGSTOP)
        time.sleep(0.2)
        run.send("world", signal.SIGCONT)
        run.over()
        before = run.slip()
        flown = finish(outcome, run)
        after = run.slip()
        stamps = np.diff(flown["/ground_truth"]["stamp_ns"])
        outcome.true("no tick is skipped", bool((stamps == 10_000_000).all()))
        counters = flown["/command_applied"]
        pairs = list(zip(counters["epoch"].tolist(), counters["counter"].tolist(), strict=True))
        outcome.true("commands applied in order, none twice", pairs == sorted(set(pairs)))
        late, slipped = _longest_stall(flown, stopped_ns)
        outcome.least("the pause, as world has noticed it", late, 0.185, "s")
        outcome.most(
            "50 ms of it are made up for, give or take", abs(late - slipped - 0.05), 0.012, "s"
        )
        # World may slip at any time on a busy machine: what is recorded lies between two scrapes.
        told = float(flown["/lateness"]["slip_ns"][-1]) * 1e-9
        shown = before - 1e-6 <= told <= after + 1e-6
        outcome.true("metric world_slip_seconds_total shows what was recorded", shown)
        outcome.least("of which the pause", slipped, 0.13, "s")
    return outcome


def _longest_stall(flown: Recording, since_ns: int) -> tuple[float, float]:
    """How late world's latest wake within 1 s was [s], and by how much its clock slipped then [s].

    On a busy machine it slips now and then; what one wake shows is its own.
    """
    wakes = flown["/lateness"]
    machine_ns = wakes["stamp_ns"] + wakes["slip_ns"]
    there = (machine_ns >= since_ns) & (machine_ns <= since_ns + 1_000_000_000)
    (rows,) = np.nonzero(there)
    row = int(rows[wakes["lateness"][rows].argmax()])
    slipped_ns = int(wakes["slip_ns"][row] - wakes["slip_ns"][row - 1])
    return float(wakes["lateness"][row]), slipped_ns * 1e-9


def _shutdown(seed: int) -> Outcome:
    """SIGTERM of both at once, as a pod's containers get it; cloud first, which has to wait."""
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(WORKING)
        asked = time.monotonic() - run.slip()
        for name, took in run.end("cloud", "teleop").items():
            outcome.most(f"{name} ends after", took, 2.0, "s")
            outcome.same(f"exit code of {name}", run.running[name].returncode, 0)
        outcome.true("the journal says so", "paused" in run.events())
        run.start("teleop")
        run.start("cloud")
        guard = finish(outcome, run)["/guard"]
        stamps, causes = guard["stamp_ns"] * 1e-9, guard["cause"].tolist()
        first = int(np.searchsorted(stamps, asked))
        outcome.most("HOLD after", float(stamps[first]) - asked, 0.5, "s")
        outcome.true("by their word, not for want of it", causes[first] == Cause.ENDED.words)
    return outcome


REAL: Mode = "real"
KILLS = (
    Scenario(
        13,
        "cloud-killed",
        "SIGKILL of the cloud process in the pipes, a new one at once",
        "HOLD by 252 ms; the new process commands in <= 2 s; the mission goes on",
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
        "a cgroup gives the cloud process 2 ms of each 100 for 5 s, then of each 1,000 for 5 s",
        "stalls ride inside the age limit, else HOLD",
        "none",
        "-",
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
        "SIGTERM of cloud and teleop at once in a mission, then new ones",
        "both end in 2 s with exit code 0, HOLD in 0.5 s by their word; the journal is written; "
        "the mission goes on",
        "none",
        "paused by shutdown",
        _shutdown,
        REAL,
    ),
    Scenario(
        39,
        "world-paused",
        "SIGSTOP of the world process for 200 ms",
        "no tick is skipped, no command applied twice; all but 50 ms of it slips",
        "none",
        "cloudrc_world_slip_seconds_total",
        _world_paused,
        REAL,
    ),
)


SOCKET = "api.sock"
KEY = "--key=job-1"


def _twice(seed: int) -> Outcome:
    outcome, api = Outcome(), f"--api=unix:{SOCKET}"
    with Processes(seed=seed, teleop=(api,)) as run:
        asked = Api(f"unix:{run.folder / SOCKET}")
        run.until("the robot is seen", lambda: _sees(asked))
        pods = [run.order(api, KEY) for _ in range(2)]
        finish(outcome, run)
        said = [pod.communicate(timeout=LIMIT)[0] for pod in pods]
        named = [re.search(r"^mission (\w+): ", text, re.MULTILINE) for text in said]
        outcome.true("both are answered with a mission", all(named))
        ids = {found[1] for found in named if found}
        outcome.same("missions that they are answered with", len(ids), 1)
        ends = {
            (pod.returncode, text.splitlines()[-1]) for pod, text in zip(pods, said, strict=True)
        }
        outcome.same("ends that they report, exit code and last line", len(ends), 1)
        made = asked.get("/v1/missions")["missions"]
        outcome.same("missions made by 2 orders under one key", len(made), 1)
        outcome.same("missions that were begun", run.events().count("started"), 1)
    return outcome


def _sees(api: Api) -> bool:
    try:
        return api.get("/v1/state")["seen"] is not None
    except UnreachableError:
        return False


JOBS = (
    Scenario(
        35,
        "job-twice",
        "two processes of `cloudrc mission fly` at once, with the same key",
        "one mission, flown once; both report its end",
        "none",
        "the same mission; no metric",
        _twice,
        REAL,
    ),
)


SCENARIOS = (
    *KILLS,
    *JOBS,
)
