"""A Job followed to its end: its name comes in; its lines, its verdict or its trouble go out."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from cloudrc.cluster import manifest
from cloudrc.cluster.access import Release
from cloudrc.cluster.errors import ClusterError, WaitedTooLongError, explained, insist
from cloudrc.cluster.jobs import JobStatus, has_started, pod_of, read_job
from cloudrc.cluster.pods import missing_secret, refusal, trouble

LOOK_PERIOD = 0.5
"""Between two looks at a Job [s]."""
READ_LIMIT = 30.0
"""For a log to say anything before the Job itself is looked at again [s]."""
END_ALLOWANCE = 60.0
"""For Kubernetes to end a Job that is past its deadline [s]."""


def patience(limit: float, queue: bool) -> float:
    """Say how long to follow a Job: until Kubernetes itself has ended it [s].

    Args:
        limit: As given to `run_job` [s].
        queue: Likewise.
    """
    return manifest.deadline(limit, queue) + END_ALLOWANCE


def follow(
    release: Release, name: str, write: Callable[[str], None], *, timeout: float
) -> JobStatus:
    """Pass on what a Job says, line by line, until it has ended.

    Args:
        release: Where the Job is.
        name: Of the Job.
        write: Gets each line of its log once.
        timeout: How long to follow at most [s].

    Returns:
        The Job's end.

    Raises:
        ClusterError: If the Job's pod cannot run; says why.
        WaitedTooLongError: If it has not ended in time.
    """
    until, told = time.monotonic() + timeout, 0
    while True:
        status, lines = insist(lambda: _look(release, name), write)
        for line in lines[told:]:
            write(line)
        told = max(told, len(lines))
        if status.state in ("complete", "failed"):
            return status
        if status.state == "pending":
            insist(partial(_refuse_hopeless, release, status), write)
        if time.monotonic() > until:
            raise WaitedTooLongError(
                f"Job '{name}' has not ended within {timeout:g} s, it goes on; "
                f"look: cloudrc mission status {name} {' '.join(release.cloudrc_flags)}"
            )
        time.sleep(LOOK_PERIOD)


def _look(release: Release, name: str) -> tuple[JobStatus, list[str]]:
    status = read_job(release, name)
    return status, _log(release, status.uid)


def logs(release: Release, name: str) -> list[str]:
    """Read what a Job has said so far.

    Raises:
        ClusterError: If there is no such Job.
    """
    return _log(release, read_job(release, name).uid)


def _log(release: Release, uid: str) -> list[str]:
    pod = pod_of(release, uid)
    if pod is None or not has_started(pod):
        return []
    with explained("get pods/log", release.where):
        text: str = release.core.read_namespaced_pod_log(
            pod.metadata.name, release.namespace, _request_timeout=READ_LIMIT
        )
    return text.splitlines()


def _refuse_hopeless(release: Release, status: JobStatus) -> None:
    pod = pod_of(release, status.uid)
    if pod is None:
        why = refusal(release, "Job", status.name)
    else:
        why = trouble(pod) or missing_secret(release, pod)
    if why:
        raise ClusterError(
            f"Job '{status.name}' cannot start: {why}; then delete it: "
            f"kubectl {' '.join(release.flags)} delete job {status.name}"
        )
