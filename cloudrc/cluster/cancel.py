"""Ends a mission from outside: a Job's name comes in; the robot holds, the Job ends."""

from __future__ import annotations

import json
import urllib.error
import urllib.request
from typing import Any

from cloudrc.cluster.access import Release
from cloudrc.cluster.errors import ClusterError
from cloudrc.cluster.forward import API_PORT, DIRECTLY, forwarded
from cloudrc.cluster.jobs import delete_job, read_job
from cloudrc.cluster.pods import find_pod

ANSWER_LIMIT = 10.0
"""For the API to answer [s]."""


def cancel(release: Release, name: str) -> str:
    """Cancel the mission of a Job, or the Job itself where it has not posted its mission yet.

    Args:
        release: Where it flies.
        name: Of the Job.

    Returns:
        What was done, in words.

    Raises:
        ClusterError: If there is no such Job, or the API does not answer.
    """
    status = read_job(release, name)
    if status.state in ("complete", "failed"):
        return f"Job '{name}' has ended already: {status.message or status.state}"
    pod = find_pod(release, "cloud").metadata.name
    with forwarded(release, pod, [API_PORT]) as ports:
        api = f"http://127.0.0.1:{ports[API_PORT]}/v1/missions"
        missions = _ask(api)
        if isinstance(missions, dict):
            missions = missions["missions"]
        found = next((m["id"] for m in missions if m.get("key") == status.uid), None)
        if found is not None:
            _ask(f"{api}/{found}/cancel", post=True)
            return f"mission {found} of Job '{name}' is cancelled"
    delete_job(release, name)
    return f"Job '{name}' had not posted its mission: deleted"


def _ask(url: str, *, post: bool = False) -> Any:
    request = urllib.request.Request(url, method="POST" if post else "GET")
    try:
        with DIRECTLY.open(request, timeout=ANSWER_LIMIT) as answer:
            return json.loads(answer.read() or b"null")
    except urllib.error.HTTPError as error:
        said = error.read().decode(errors="replace")
        raise ClusterError(f"the API refuses ({error.code}): {said}") from error
    except (urllib.error.URLError, OSError, ValueError) as error:
        raise ClusterError(f"the API does not answer: {error}") from error
