"""Run `cloudrc list releases`: the releases of a cluster, each with its link, state and mission."""

from __future__ import annotations

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING

from cloudrc.cli.cluster_flags import release_from_flags
from cloudrc.cli.output import print_line, print_result
from cloudrc.cluster.missions import release_api
from cloudrc.errors import CloudrcError
from cloudrc.text import table

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release

HEADS = ("NAME", "NAMESPACE", "ROBOT", "LINK", "STATE", "MISSION")
AT_ONCE = 8
"""Number of releases that are asked for their mission at the same time."""
UNKNOWN = "?"
"""Mission of a release whose API does not answer."""


def list_releases(options: argparse.Namespace) -> int:
    """Print the releases of all namespaces, or of the namespace that the flags name."""
    from cloudrc.cluster.client import ClusterError
    from cloudrc.cluster.releases import look, namespace_exists, no_release

    here = release_from_flags(options)
    try:
        found = look(here, everywhere=not options.namespace)
    except ClusterError as error:
        if options.namespace:
            raise
        print_line(f"cloudrc: note: only the releases {here.where}: {error}", sys.stderr)
        found = look(here, everywhere=False)
    if not found and options.namespace and not namespace_exists(here):
        raise no_release(here)
    places = [replace(here, namespace=each.namespace, name=each.name) for each in found]
    with ThreadPoolExecutor(AT_ONCE) as pool:
        missions = list(pool.map(_mission_of, places))
    rows = [(*each, mission) for each, mission in zip(found, missions, strict=True)]
    keys = [head.lower() for head in HEADS]
    entries = {"releases": [dict(zip(keys, row, strict=True)) for row in rows]}
    text = table([HEADS, *rows]) if rows else "no releases; install one: helm install"
    print_result(options.output, entries, text)
    return 0


def _mission_of(release: Release) -> str:
    """Describe the mission under way on a release; "-" for none, `UNKNOWN` without an answer."""
    try:
        with release_api(release) as api:
            mission = api.get("/v1/state")["mission"]
    except CloudrcError as error:
        print_line(f"cloudrc: note: release '{release.name}' {release.where}: {error}", sys.stderr)
        return UNKNOWN
    if mission is None:
        return "-"
    return f"{mission['id']} {mission['state']} {len(mission['reached'])}/{mission['waypoints']}"
