"""A release in a Kubernetes cluster, for scenarios: fly on it, look at it, do something to it."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from cloudrc.cluster.access import Release, connect
from cloudrc.cluster.fetch import fetch_metrics, fetch_recording
from cloudrc.cluster.follow import logs
from cloudrc.cluster.jobs import read_job, run_job
from cloudrc.cluster.pods import find_pod
from cloudrc.cluster.tools import run as call
from cloudrc.config.load import load_mission
from cloudrc.errors import CloudrcError, TimedOutError
from cloudrc.faults.family_real import AGE_MAX, PERIOD, pause
from cloudrc.faults.scenario import Outcome
from cloudrc.messages import GuardState
from cloudrc.record.columns import Recording

LIMIT = 150.0
"""For whatever is waited for [s]."""
ENDS = ("complete", "failed")
place: dict[str, str] = {"namespace": "default", "release": "cloudrc"}
"""Where the release is; the command line puts it here."""


def release_there() -> Release:
    """Connect to the release that the command line named."""
    return connect(None, place["namespace"], place["release"])


def flying(release: Release, number: int) -> str:
    """Fly the paper's mission by a Job, until so many waypoints are reached.

    Returns:
        The Job's name.
    """
    mission = load_mission("pipes").model_dump(mode="json")
    waypoints = {"name": "faults", "time_limit_s": LIMIT, "waypoints": mission["waypoints"]}
    name = run_job(release, waypoints, limit=LIMIT).name
    line = f"waypoint {number} of 7 reached"
    until(line, lambda: any(line in each for each in log(release, name)))
    return name


def log(release: Release, name: str) -> list[str]:
    """Read what a Job has said; nothing while its pod does not run."""
    try:
        return logs(release, name)
    except CloudrcError:  # its pod does not run yet
        return []


def until(text: str, condition: Callable[[], bool], limit: float = LIMIT) -> float:
    """Wait until something has come about.

    Args:
        text: What, in words.
        condition: Whether it has.
        limit: For how long [s].

    Returns:
        How long that took [s].

    Raises:
        TimedOutError: If it does not.
    """
    began = time.monotonic()
    while not condition():
        if time.monotonic() - began > limit:
            raise TimedOutError(f"{text}: not within {limit:g} s")
        pause(PERIOD)
    return time.monotonic() - began


def guard(release: Release) -> GuardState:
    """Look at the guard's state in world's own metrics."""
    for line in fetch_metrics(release, "world")["world"].splitlines():
        if line.startswith("cloudrc_guard_state "):
            return GuardState(int(float(line.split()[1])))
    return GuardState.GROUND


def finish(outcome: Outcome, release: Release, name: str) -> None:
    """The Job has succeeded, each waypoint was reached once, no pipe was touched."""
    until("the mission's Job has ended", lambda: read_job(release, name).state in ENDS)
    status, lines = read_job(release, name), log(release, name)
    outcome.same("exit code of the Job", -1 if status.exit_code is None else status.exit_code, 0)
    counts = [sum(f"waypoint {n} of 7 reached" in line for line in lines) for n in range(1, 8)]
    outcome.true("each waypoint reached once", counts == [1] * 7)
    flown = recording(release, "world")
    bodies = flown["/contact"]["body"].tolist()
    outcome.same("pipe contacts", sum(body.startswith("pipe") for body in bodies), 0)
    outcome.most("HOLD, if any, after", age_at_hold(flown), AGE_MAX + 1e-9, "s")


def recording(release: Release, component: str) -> Recording:
    """Fetch the recording of an end as it is now."""
    pause(1.0)  # the recorder's flush
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.mcap"
        fetch_recording(release, component, path)
        return Recording.read(path)


def age_at_hold(recording: Recording) -> float:
    """Find the largest age of the newest applied basis when the guard went to HOLD [s]."""
    applied, guard = recording["/command_applied"], recording["/guard"]
    held = (guard["state"] == GuardState.HOLD) & ["age" in cause for cause in guard["cause"]]
    ages = [0.0]
    for stamp_ns in guard["stamp_ns"][held].tolist():
        before = applied["basis_stamp_ns"][applied["stamp_ns"] <= stamp_ns]
        if len(before):
            ages.append((stamp_ns - int(np.max(before))) * 1e-9)
    return max(ages)


def holds(recording: Recording) -> int:
    """Count the HOLDs for want of fresh commands."""
    guard = recording["/guard"]
    return sum(
        GuardState(int(state)) is GuardState.HOLD and "age" in cause
        for state, cause in zip(guard["state"].tolist(), guard["cause"].tolist(), strict=True)
    )


def kubectl(release: Release, *words: str, given: str = "", timeout: float = 60.0) -> str:
    """Run kubectl where the release is.

    Args:
        release: Where.
        words: Its arguments.
        given: What it reads.
        timeout: How long it may take [s].
    """
    return call("kubectl", [*release.flags, *words], timeout=timeout, given=given)


def delete(release: Release, component: str, *flags: str) -> None:
    """Delete a pod without waiting for its end."""
    pod = find_pod(release, component).metadata.name
    kubectl(release, "delete", "pod", pod, "--wait=false", *flags)
