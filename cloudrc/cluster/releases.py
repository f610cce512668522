# SPDX-License-Identifier: Apache-2.0

"""Find the releases of cloudrc: the only one of a namespace, or all of a cluster."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import yaml

from cloudrc.base.errors import BadInputError, StateError
from cloudrc.cluster import DEFAULT_RELEASE
from cloudrc.cluster.client import (
    ClusterError,
    Release,
    connect,
)

INSTANCE = "app.kubernetes.io/instance"
"""Label with the name of the release."""
COMPONENT = "app.kubernetes.io/component"
CLOUDRC = "app.kubernetes.io/name=cloudrc"


class Place(NamedTuple):
    """Where a release is."""

    namespace: str
    name: str


def look(release: Release, *, everywhere: bool) -> list[dict[str, str]]:
    """Describe the releases in the namespace of `release`, or in all namespaces.

    Raise a ClusterError if the user may not list Deployments, StatefulSets or ConfigMaps there. A
    fleet has a mission, from its Job, too.
    """
    verb, chosen = "list all" if everywhere else "list", {"label_selector": CLOUDRC}
    workloads = release.request(verb, "deployments", **chosen)
    fleets = release.request(verb, "statefulsets", **chosen)
    jobs = release.request(verb, "jobs", **chosen) if fleets else []
    files = defaultdict[Place, dict[str, str]](dict)
    for each in release.request(verb, "configmaps", **chosen):
        if each.metadata.labels.get(COMPONENT) in ("experiment", "link"):
            files[_place(each)] |= each.data or {}
    waits = defaultdict[Place, list[str]](list)
    for each in [*workloads, *fleets]:
        ready, wanted = each.status.available_replicas or 0, each.spec.replicas or 1
        count = f" {ready}/{wanted}" if wanted > 1 else ""
        not_ready = [] if ready >= wanted else [each.metadata.labels[COMPONENT] + count]
        waits[_place(each)] += not_ready
    robots = {_place(each): each.spec.replicas for each in fleets if _is_world(each)}
    return [
        {
            "name": place.name,
            "namespace": place.namespace,
            "robot": f"{robots.get(place, '')} {_robot(files[place])}".strip(),
            "link": _link(files[place]),
            "state": f"{' and '.join(sorted(waits[place]))} not ready" if waits[place] else "ready",
            **({"mission": _mission(place, jobs)} if place in robots else {}),
        }
        for place in sorted(waits)
    ]


def _is_world(thing: Any) -> bool:
    return bool(thing.metadata.labels[COMPONENT] == "world")


def _mission(place: Place, jobs: list[Any]) -> str:
    """Describe the Job that a fleet flies, by the number of robots; "-" for none."""
    for job in jobs:
        if _place(job) == place and job.status.active and job.spec.completion_mode == "Indexed":
            counts = {
                "flying": job.status.active,
                "done": job.status.succeeded,
                "failed": job.status.failed,
            }
            words = [f"{word} {count}" for word, count in counts.items() if count]
            return f"{job.metadata.name} {', '.join(words)}"
    return "-"


def _place(thing: Any) -> Place:
    return Place(thing.metadata.namespace, thing.metadata.labels.get(INSTANCE, ""))


def _section(files: dict[str, str], name: str) -> dict[str, Any]:
    return (yaml.safe_load(files.get("experiment.yaml", "")) or {}).get(name) or {}


def _robot(files: dict[str, str]) -> str:
    from cloudrc.config.schema import World

    robot = _section(files, "world").get("robot") or World().robot
    return Path(robot).name  # of the user's robot, the name of its ConfigMap


def _link(files: dict[str, str]) -> str:
    """Describe a link: delay and jitter of both directions, and what else is set.

    `files` are those of the release's ConfigMaps with the experiment and the link.
    """
    from cloudrc.config.load import load_link
    from cloudrc.config.profile import DIRECTIONS

    with TemporaryDirectory(prefix="cloudrc-") as name:
        folder = Path(name)  # the files as the pods see them
        for key, text in {"experiment.yaml": "{}", "profile.yaml": "{}", **files}.items():
            (folder / key).write_text(text, encoding="utf-8")
        try:
            link = load_link(folder / "profile.yaml", folder / "experiment.yaml")
        except BadInputError:
            return "invalid"
    values = link.model_dump(mode="json", exclude_defaults=True)
    texts = [_way(values.get(way, {})) for way in DIRECTIONS]
    rate = _section(files, "cell").get("rate_kbit")
    cell = f", cell {rate:g}" if rate else ""
    return (texts[0] if texts[0] == texts[1] else " / ".join(texts)) + cell


def _way(way: dict[str, Any]) -> str:
    jitter = f"\u00b1{way['jitter_ms']:g}" if way.get("jitter_ms") else ""
    more = [key for key in way if key not in ("delay_ms", "jitter_ms")]
    return ", ".join([f"{way.get('delay_ms') or 0:g}{jitter} ms", *more])


def only_release(release: Release) -> Release:
    """Return the only release in the namespace of `release`; its name does not matter.

    Raises:
        StateError: If the namespace has several releases.
        ClusterError: If the namespace does not exist, or has no release.
    """
    names = [
        _place(each).name
        for kind in ("deployments", "statefulsets")
        for each in release.request("list", kind, label_selector=f"{CLOUDRC},{COMPONENT}=world")
    ]
    if len(names) > 1:
        raise several_releases(release, names)
    if not names:
        raise no_release(release, f"no release {release.where}")
    return replace(release, name=names[0])


def choose_release(
    context: str | None = None, namespace: str | None = None, name: str | None = None
) -> Release:
    """Select the release `name`; with None, the only one of the namespace.

    Raises:
        MissingPrerequisiteError: If there is no valid kubeconfig.
        StateError: If the namespace has several releases.
        ClusterError: If it has none.
    """
    release = connect(context, namespace, name or DEFAULT_RELEASE)
    return release if name else only_release(release)


def several_releases(release: Release, names: list[str]) -> StateError:
    """Return the error that a namespace has several releases."""
    return StateError(
        f"several releases {release.where}: {', '.join(sorted(names))}; name one: --release NAME"
    )


def no_release(release: Release, what: str = "") -> ClusterError:
    """Return the error that a release does not exist.

    `what` is the beginning of its text, by default "no release 'NAME' in namespace ...".
    """
    what = what or f"no {release}"
    return ClusterError(
        what,
        fix="see all: helm list --all-namespaces; name one: --release NAME -n NAMESPACE, or "
        "install it: helm install",
    )
