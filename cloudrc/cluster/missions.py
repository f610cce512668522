# SPDX-License-Identifier: Apache-2.0

"""Call the API of a release over a forwarded port."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cloudrc.base.errors import CloudrcError, InterruptedRunError
from cloudrc.cluster.client import Release
from cloudrc.cluster.jobs import Ended
from cloudrc.cluster.pods import API_PORT, find_pod, forwarded, operator_token
from cloudrc.teleop.client import Api, describe_mission, find_mission, mission_path


@contextmanager
def release_api(release: Release, token: Callable[[], str] | None = None) -> Iterator[Api]:
    """Yield the API of a release, over a forwarded port, while the `with` block runs.

    `token` returns the API's token; by default it comes from the release's Secret.
    """
    known = operator_token(release) if token is None else ""
    pod = find_pod(release, "cloud").metadata.name
    with forwarded(release, pod, [API_PORT]) as ports:
        yield Api(f"http://127.0.0.1:{ports[API_PORT]}", token or (lambda: known), str(release))


def settle_mission(release: Release, key: str, why: str) -> Ended:
    """Cancel the mission of a Job that no longer follows it, if the mission has not ended.

    `key` is the mission's key, `why` the reason. Return how the mission has ended.
    """
    text = f"no mission has begun: {why}"
    try:
        with release_api(release) as api:
            mission = find_mission(api, key)
            if mission is not None and mission["verdict"] is not None:
                return Ended(int(mission["verdict"]["exit_code"]), describe_mission(mission))
            if mission is not None:
                api.post(f"{mission_path(mission['id'])}/cancel")
                text = f"mission {mission['id']} is cancelled: {why}"
    except CloudrcError as error:
        text = f"{why}; the mission ends with its lease, because it cannot be cancelled: {error}"
    return Ended(InterruptedRunError.exit_code, text)
