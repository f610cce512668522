"""The link of a release while it flies: its profile's ConfigMap, and what its containers tell.

kubectl does all of it: it starts in a tenth of a second, the Python client in half of one, and a
change of the link is to be in force within a second.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cloudrc.cluster.tools import run

PROFILE = "profile.yaml"
"""Key of the ConfigMap."""
COMPONENTS = ("world", "cloud")
"""Whose link containers shape uplink and downlink."""
READ_LIMIT = 15.0
"""For the API server to answer [s]."""
_COMPONENT = "app.kubernetes.io/component"


@dataclass(frozen=True)
class Place:
    """Where a release is, as kubectl is told; None is its own default.

    Attributes:
        context: Of the kubeconfig.
        namespace: Where the release is.
        name: Of the release, as Helm knows it.
    """

    context: str | None
    namespace: str | None
    name: str

    @property
    def flags(self) -> list[str]:
        """What kubectl has to be told."""
        context = [f"--context={self.context}"] if self.context else []
        return context + ([f"--namespace={self.namespace}"] if self.namespace else [])


@dataclass(frozen=True)
class LinkParts:
    """What there is of a release's link.

    Attributes:
        name: Of the ConfigMap that the link containers follow.
        files: Its files: the profile, its traces, who changed it.
        pods: The newest running pod of each component.
    """

    name: str
    files: dict[str, str]
    pods: dict[str, str]


def read_link(place: Place) -> LinkParts | None:
    """Look at a release with one request of kubectl; None if its link is not there, or in part.

    Raises:
        ClusterError: If kubectl fails; with what it said.
    """
    selector = f"app.kubernetes.io/name=cloudrc,app.kubernetes.io/instance={place.name}"
    words = [*place.flags, "get", "configmaps,pods", f"--selector={selector}", "--output=json"]
    found = json.loads(run("kubectl", words, timeout=READ_LIMIT))["items"]
    maps = [one for one in found if one["kind"] == "ConfigMap" and PROFILE in one.get("data", {})]
    pods = {part: _newest(found, part) for part in COMPONENTS}
    if not maps or None in pods.values():
        return None
    named = {part: str(name) for part, name in pods.items()}
    return LinkParts(str(maps[0]["metadata"]["name"]), dict(maps[0]["data"]), named)


def write_files(place: Place, name: str, files: Mapping[str, str]) -> None:
    """Put files into the ConfigMap; those not named stay.

    Raises:
        ClusterError: If it is refused.
    """
    words = ["patch", "configmap", name, "--type=merge", "--patch-file=/dev/stdin"]
    run("kubectl", [*place.flags, *words], timeout=READ_LIMIT, given=json.dumps({"data": files}))


def _newest(found: list[dict[str, Any]], component: str) -> str | None:
    """Name the newest running pod of a component."""
    pods = [
        one["metadata"]
        for one in found
        if one["kind"] == "Pod"
        and one["metadata"]["labels"].get(_COMPONENT) == component
        and one["status"].get("phase") == "Running"
        and "deletionTimestamp" not in one["metadata"]
    ]
    newest = max(pods, key=lambda one: str(one["creationTimestamp"]), default=None)
    return str(newest["name"]) if newest else None
