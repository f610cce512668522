"""The link of a release while it flies: its profile's ConfigMap, and what its containers tell.

A kubelet looks at the ConfigMaps of its pods about once a minute; a change of the pod itself, of
an annotation at least, makes it look at once.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass

from cloudrc.cluster.access import REQUEST_TIMEOUT, Release
from cloudrc.cluster.errors import ClusterError, explained
from cloudrc.cluster.pods import find_pod
from cloudrc.cluster.tools import run

PROFILE = "profile.yaml"
"""Key of the ConfigMap."""
COMPONENTS = ("world", "cloud")
STATE = "/run/cloudrc/link.json"
"""Where the link container of a pod tells its state."""
ANNOTATION = "cloudrc/link-change"
NUDGE_PERIOD = 2.0
"""Between two annotations of a pod: the first may come before the kubelet knows the change [s]."""
READ_LIMIT = 15.0
"""For a pod's state to be read [s]."""


@dataclass(frozen=True)
class ProfileMap:
    """The ConfigMap that the link containers follow.

    Attributes:
        name: Of the ConfigMap.
        files: Its files: the profile, its traces, who changed it.
    """

    name: str
    files: dict[str, str]


def read_profile_map(release: Release) -> ProfileMap:
    """Read the profile of a release.

    Raises:
        ClusterError: If there is no such release.
    """
    with explained("list configmaps", release.where):
        found = release.core.list_namespaced_config_map(
            release.namespace,
            label_selector=release.selector("link"),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    for one in found:
        if PROFILE in (one.data or {}):
            return ProfileMap(str(one.metadata.name), dict(one.data))
    find_pod(release, "world")  # says best that the release is not there
    raise ClusterError(
        f"release '{release.name}' {release.where} has no profile to change; "
        "is it a release of cloudrc? see: helm list --all-namespaces"
    )


def write_profile_map(release: Release, name: str, files: Mapping[str, str | None]) -> None:
    """Put files into the ConfigMap; None takes one out, those not named stay."""
    with explained("patch configmaps", release.where):
        release.core.patch_namespaced_config_map(
            name, release.namespace, {"data": dict(files)}, _request_timeout=REQUEST_TIMEOUT
        )


class LinkPods:
    """The two pods of a release whose links are to take a change over."""

    def __init__(self, release: Release, change: str) -> None:
        """Find them, and have their kubelets look at the ConfigMap.

        Args:
            release: Whose link changes.
            change: Number of the change.
        """
        self._release, self._change, self._nudges = release, change, 0
        self._pods = [str(find_pod(release, part).metadata.name) for part in COMPONENTS]
        self._nudged = 0.0
        self._nudge()

    def states(self) -> list[str]:
        """Read what both link containers tell now, the uplink's first; JSON texts."""
        if time.monotonic() - self._nudged > NUDGE_PERIOD:
            self._nudge()
        flags = self._release.flags
        return [
            run(
                "kubectl",
                [*flags, "exec", pod, "--container=link", "--", "cat", STATE],
                timeout=READ_LIMIT,
            )
            for pod in self._pods
        ]

    def _nudge(self) -> None:
        self._nudged, self._nudges = time.monotonic(), self._nudges + 1
        body = {"metadata": {"annotations": {ANNOTATION: f"{self._change}.{self._nudges}"}}}
        for pod in self._pods:
            with explained("patch pods", self._release.where):
                self._release.core.patch_namespaced_pod(
                    pod, self._release.namespace, body, _request_timeout=REQUEST_TIMEOUT
                )
