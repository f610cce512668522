# SPDX-License-Identifier: Apache-2.0

"""List the releases of a cluster, each with its link, its state and its mission."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial

from cloudrc.base.errors import CloudrcError
from cloudrc.base.text import table
from cloudrc.cluster.client import ClusterError, Release
from cloudrc.cluster.missions import release_api
from cloudrc.cluster.releases import look

AT_ONCE = 8
"""Number of releases that are asked for their mission at the same time."""
UNKNOWN = "?"
"""Mission of a release whose API does not answer."""


def list_releases(
    here: Release, *, everywhere: bool, tell: Callable[[str], None]
) -> list[dict[str, str]]:
    """Describe the releases in the namespace of `here`, or in all namespaces.

    `tell` receives a note if only that namespace may be listed, and why a mission is not known.
    Raise a ClusterError if the releases may not be listed,.
    """
    try:
        found = look(here, everywhere=everywhere)
    except ClusterError as error:
        if not everywhere:
            raise
        tell(f"only the releases {here.where}: {error}")
        found = look(here, everywhere=False)
    single = [each for each in found if "mission" not in each]
    places = [replace(here, namespace=each["namespace"], name=each["name"]) for each in single]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        missions = pool.map(partial(_mission_of, tell=tell), places)
    for each, mission in zip(single, missions, strict=True):
        each["mission"] = mission
    return found


def as_text(releases: Sequence[dict[str, str]]) -> str:
    """Format the result of `list_releases` for people."""
    if not releases:
        return "no releases; install one: helm install"
    heads = tuple(key.upper() for key in releases[0])
    return table([heads, *(tuple(each.values()) for each in releases)])


def _mission_of(release: Release, tell: Callable[[str], None]) -> str:
    """Describe the mission under way on a release; "-" for none, `UNKNOWN` without an answer."""
    try:
        with release_api(release) as api:
            mission = api.get("/v1/state")["mission"]
    except CloudrcError as error:
        tell(f"{release}: {error}")
        return UNKNOWN
    if mission is None:
        return "-"
    return f"{mission['id']} {mission['state']} {len(mission['reached'])}/{mission['waypoints']}"
