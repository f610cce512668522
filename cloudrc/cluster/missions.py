"""Call the API of a release over a forwarded port."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from cloudrc.cluster.client import Release
from cloudrc.cluster.pods import API_PORT, find_pod, forwarded, operator_token
from cloudrc.errors import CloudrcError, InterruptedRunError
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


def settle_mission(release: Release, key: str, why: str) -> tuple[str, int]:
    """Cancel the mission of a Job that no longer follows it, if the mission has not ended.

    `key` is the mission's key, `why` the reason. Return a sentence about the mission, and the exit
    code of its verdict.
    """
    interrupted = InterruptedRunError.exit_code
    try:
        with release_api(release) as api:
            mission = find_mission(api, key)
            if mission is None:
                return f"no mission has begun: {why}", interrupted
            if mission["verdict"] is None:
                api.post(f"{mission_path(mission['id'])}/cancel")
                return f"mission {mission['id']} is cancelled: {why}", interrupted
            return describe_mission(mission), int(mission["verdict"]["exit_code"])
    except CloudrcError as error:
        text = f"{why}; the mission ends with its lease, because it cannot be cancelled: {error}"
        return text, interrupted
