"""A release in a Kubernetes cluster, for scenarios: fly on it, look at it, do something to it."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from cloudrc.cluster.client import DEFAULT_RELEASE, Release, connect
from cloudrc.cluster.jobs import logs, read_job, run_job
from cloudrc.cluster.link import PROFILE, ReleasePlace, read_link
from cloudrc.cluster.pods import fetch_metrics, fetch_recording, find_pod
from cloudrc.cluster.tools import ClusterError
from cloudrc.cluster.tools import run as call
from cloudrc.config.load import load_mission
from cloudrc.errors import CloudrcError, TimedOutError
from cloudrc.faults.held import AGE_MAX, age_at_hold
from cloudrc.faults.scenario import Outcome
from cloudrc.messages import GuardState
from cloudrc.record.columns import Recording

LIMIT = 150.0
"""For whatever is waited for [s]."""
PERIOD = 0.2
"""Between two looks at whether something has come about [s]."""
ENDS = ("complete", "failed")
place: dict[str, str | None] = {}
"""Where the release is: context, namespace, release; the command line puts it here."""


def release_there() -> Release:
    """Connect to the release that the command line named."""
    release = place.get("release") or DEFAULT_RELEASE
    return connect(place.get("context"), place.get("namespace"), release)


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
        time.sleep(PERIOD)
    return time.monotonic() - began


def guard(release: Release) -> GuardState:
    """Look at the guard's state in world's own metrics."""
    return GuardState(int(reading(release, "world", "guard_state")))


def reading(release: Release, component: str, name: str) -> float:
    """Read a metric without labels of an end's own container [any unit]; 0 if it is not there."""
    for line in fetch_metrics(release, component)[component].splitlines():
        if line.startswith(f"cloudrc_{name} "):
            return float(line.split()[1])
    return 0.0


def finish(outcome: Outcome, release: Release, name: str) -> Recording:
    """Check that the Job has succeeded, each waypoint was reached once, no pipe was touched.

    Returns:
        World's recording up to then.
    """
    until("the mission's Job has ended", lambda: read_job(release, name).state in ENDS)
    status, lines = read_job(release, name), log(release, name)
    outcome.same("exit code of the Job", -1 if status.exit_code is None else status.exit_code, 0)
    counts = [sum(f"waypoint {n} of 7 reached" in line for line in lines) for n in range(1, 8)]
    outcome.true("each waypoint reached once", counts == [1] * 7)
    flown = recording(release, "world")
    bodies = flown["/contact"]["body"].tolist()
    outcome.same("pipe contacts", sum(body.startswith("pipe") for body in bodies), 0)
    outcome.most("HOLD, if any, after", age_at_hold(flown), AGE_MAX, "s")
    return flown


def recording(release: Release, component: str) -> Recording:
    """Fetch the recording of an end as it is now."""
    time.sleep(1.0)  # the recorder's flush
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "recording.mcap"
        fetch_recording(release, component, path)
        return Recording.read(path)


def kubectl(release: Release, *words: str, given: str = "", timeout: float = 60.0) -> str:
    """Run kubectl where the release is.

    Args:
        release: Where.
        words: Its arguments.
        given: What it reads.
        timeout: How long it may take [s].
    """
    return call("kubectl", [*release.flags, *words], timeout=timeout, given=given)


@contextmanager
def link_as_it_is(release: Release) -> Iterator[Path]:
    """Keep the profile that is in force now, with its traces, in a file."""
    link = read_link(ReleasePlace(release.context, release.namespace, release.name))
    if link is None:
        raise ClusterError(f"release '{release.name}' has no link to change")
    with tempfile.TemporaryDirectory() as folder:
        for name, text in link.files.items():
            (Path(folder) / name).write_text(text, encoding="utf-8")
        yield Path(folder) / PROFILE


def set_link(release: Release, *words: str) -> None:
    """Change the link in flight as its user does."""
    command = ["-m", "cloudrc", "link", "set", *words, *release.cloudrc_flags]
    call(sys.executable, command, timeout=60.0)


def delete(release: Release, component: str, *flags: str) -> None:
    """Delete a pod without waiting for its end."""
    pod = find_pod(release, component).metadata.name
    kubectl(release, "delete", "pod", pod, "--wait=false", *flags)
