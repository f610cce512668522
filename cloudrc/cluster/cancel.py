"""Missions from outside: a Job's name comes in and it ends; or a release, and what it flies."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from typing import Any

from cloudrc.cluster.access import Release
from cloudrc.cluster.errors import ClusterError, WaitedTooLongError
from cloudrc.cluster.forward import API_PORT, DIRECTLY, forwarded
from cloudrc.cluster.jobs import delete_job, list_jobs, read_job
from cloudrc.cluster.pods import list_pods
from cloudrc.cluster.tokens import operator_token

ANSWER_LIMIT = 10.0
"""For the API to answer [s]."""


def cancel(release: Release, name: str, token: str | None = None) -> str:
    """Cancel the mission of a Job, or the Job itself where it has not posted its mission yet.

    Args:
        release: Where it flies.
        name: Of the Job.
        token: Of an operator; None to read the release's own.

    Returns:
        What was done, in words.

    Raises:
        ClusterError: If there is no such Job, or the API of a pod that runs does not answer.
    """
    status = read_job(release, name)
    if status.state in ("complete", "failed"):
        return f"Job '{name}' has ended already: {status.message or status.state}"
    pod = _running_cloud(release)
    if not pod:
        delete_job(release, name)
        end = f"cloudrc mission cancel {' '.join(release.cloudrc_flags)}"
        return (
            f"Job '{name}' is deleted; no cloud pod runs now: if its mission was posted before, "
            f"it goes on when one does, then: {end}"
        )
    token = token or operator_token(release)
    with forwarded(release, pod, [API_PORT]) as ports:
        api = f"http://127.0.0.1:{ports[API_PORT]}/v1/missions"
        missions = _ask(api, token)["missions"]
        found = next((m for m in missions if m["key"] == status.uid), None)
        if found is not None:
            _ask(f"{api}/{found['id']}/cancel", token, post=True)
            return f"mission {found['id']} ({found['name']}) of Job '{name}' is cancelled"
    delete_job(release, name)
    return f"Job '{name}' had not posted its mission: deleted"


def under_way(release: Release) -> tuple[str, str]:
    """Say what flies on a release, or is about to.

    Args:
        release: Which need not be there yet.

    Returns:
        It in words, "" if nothing is known to fly; and the name of its Job, "" if it is not known.

    Raises:
        ClusterError: If the cluster does not say which Jobs there are.
    """
    jobs = [job.name for job in list_jobs(release) if job.state in ("pending", "flying")]
    if jobs:
        return f"Job '{jobs[0]}'", jobs[0]
    pod = _running_cloud(release)
    if not pod:
        return "", ""
    try:
        token = operator_token(release)
        with forwarded(release, pod, [API_PORT]) as ports:
            missions = _ask(f"http://127.0.0.1:{ports[API_PORT]}/v1/missions", token)["missions"]
    except (ClusterError, WaitedTooLongError):
        return "", ""  # a release that is broken may be mended by installing it again
    ended = ("done", "failed", "cancelled")
    found = next((m["id"] for m in missions if m["state"] not in ended), None)
    return (f"mission {found}" if found else ""), ""


def _running_cloud(release: Release) -> str:
    """Name the newest cloud pod that runs; "" if none does."""
    pods = list_pods(release, "cloud")
    return next((str(pod.metadata.name) for pod in pods if pod.status.phase == "Running"), "")


def _ask(url: str, token: str, *, post: bool = False) -> Any:
    headers = {"Authorization": f"Bearer {token}"}
    request = urllib.request.Request(url, headers=headers, method="POST" if post else "GET")
    try:
        with DIRECTLY.open(request, timeout=ANSWER_LIMIT) as answer:
            return json.loads(answer.read() or b"null")
    except urllib.error.HTTPError as error:
        said = error.read().decode(errors="replace")
        raise ClusterError(f"the API refuses ({error.code}): {said}") from error
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise ClusterError(f"the API does not answer: {error}") from error
