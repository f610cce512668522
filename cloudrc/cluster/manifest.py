"""A mission as Kubernetes objects: mission, release and image come in, Job and ConfigMap go out.

The same objects as `charts/cloudrc/examples/mission-job.yaml` shows by hand.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil
from typing import Any

from cloudrc.cluster.access import Release
from cloudrc.cluster.tokens import OPERATOR, VOLUME

COMPONENT = "mission"
FOLDER = "/etc/cloudrc-mission"
FILE = "mission.yaml"
TOKENS = "/etc/cloudrc-tokens"
KEY = "MISSION_KEY"
UID_LABEL = "batch.kubernetes.io/controller-uid"
"""Kubernetes puts the Job's UID under it on the Job's pod."""
START_ALLOWANCE = 120
"""Beyond the mission's own limit, for the pod to start and the robot to be seen [s]."""
QUEUE_ALLOWANCE = 3600
"""Beyond that, for the missions before it to end, where it waits in the queue [s]."""
DEADLINE_MAX = 2**31 - 1
"""What Kubernetes takes [s]."""
KEEP = 3600
"""How long a finished Job stays to be looked at [s]."""
USER = 10001


@dataclass(frozen=True)
class Follower:
    """What runs in the Job's container.

    Attributes:
        image: Image with cloudrc in it: that of the release's teleop container.
        pull_policy: Of that image.
        pull_secrets: Names of Secrets for the image's registry.
        api: URL of the release's API inside the cluster.
        tokens: Name of the Secret with the API's tokens.
        placement: `nodeSelector`, `tolerations` and `affinity` of the release's cloud pod.
        owner: Reference to the release's cloud Deployment: missions go when the release goes.
    """

    image: str
    pull_policy: str
    pull_secrets: tuple[str, ...]
    api: str
    tokens: str
    placement: Mapping[str, Any] = field(default_factory=dict)
    owner: Mapping[str, Any] | None = None


def labels(release: Release) -> dict[str, str]:
    """Label what belongs to a mission of a release; the NetworkPolicies go by it."""
    return {
        "app.kubernetes.io/name": "cloudrc",
        "app.kubernetes.io/instance": release.name,
        "app.kubernetes.io/component": COMPONENT,
        "app.kubernetes.io/part-of": "cloudrc",
        "app.kubernetes.io/managed-by": "cloudrc",
    }


def config_map(release: Release, name: str, mission: Mapping[str, Any]) -> dict[str, Any]:
    """Put the mission into a ConfigMap of the Job's name.

    Args:
        release: Whose mission it is.
        name: Of Job and ConfigMap.
        mission: As the API takes it; JSON is YAML too.
    """
    return {
        "apiVersion": "v1",
        "kind": "ConfigMap",
        "metadata": {"name": name, "labels": labels(release)},
        "data": {FILE: json.dumps(mission, indent=2) + "\n"},
    }


def deadline(limit: float, queue: bool) -> int:
    """Say how long a Job may last [s].

    Args:
        limit: The mission's own limit of time [s].
        queue: Whether it may have to wait for others.
    """
    return min(ceil(limit) + START_ALLOWANCE + queue * QUEUE_ALLOWANCE, DEADLINE_MAX)


def job(
    release: Release, name: str, follower: Follower, *, limit: float, queue: bool
) -> dict[str, Any]:
    """Make the Job that posts the mission, follows it and ends with its verdict.

    Args:
        release: Whose mission it is.
        name: Of Job and ConfigMap.
        follower: What runs in it.
        limit: The mission's own limit of time [s].
        queue: Whether to wait where another mission flies, in place of being refused.
    """
    owners = [dict(follower.owner)] if follower.owner else []
    return {
        "apiVersion": "batch/v1",
        "kind": "Job",
        "metadata": {"name": name, "labels": labels(release), "ownerReferences": owners},
        "spec": {
            # The mission is posted under the Job's UID: a second try would only read its verdict.
            "backoffLimit": 0,
            "activeDeadlineSeconds": deadline(limit, queue),
            "ttlSecondsAfterFinished": KEEP,
            "template": {
                "metadata": {"labels": labels(release)},
                "spec": _pod(name, follower, queue),
            },
        },
    }


def _pod(name: str, follower: Follower, queue: bool) -> dict[str, Any]:
    return {
        **follower.placement,
        "restartPolicy": "Never",
        "automountServiceAccountToken": False,
        "enableServiceLinks": False,
        "securityContext": {
            "runAsNonRoot": True,
            "runAsUser": USER,
            "runAsGroup": USER,
            "fsGroup": USER,
            "seccompProfile": {"type": "RuntimeDefault"},
        },
        "imagePullSecrets": [{"name": secret} for secret in follower.pull_secrets],
        "containers": [_container(follower, queue)],
        "volumes": [
            {"name": "mission", "configMap": {"name": name}},
            {"name": VOLUME, "secret": _operators_alone(follower.tokens)},
        ],
    }


def _operators_alone(secret: str) -> dict[str, Any]:
    return {
        "secretName": secret,
        "defaultMode": 0o440,
        "items": [{"key": OPERATOR, "path": OPERATOR}],
    }


def _container(follower: Follower, queue: bool) -> dict[str, Any]:
    arguments = ["mission", "fly", f"--api={follower.api}"]
    arguments += [f"--token-file={TOKENS}/{OPERATOR}", f"--mission={FOLDER}/{FILE}"]
    arguments += [f"--key=$({KEY})", *(["--queue"] if queue else [])]
    return {
        "name": "mission",
        "image": follower.image,
        "imagePullPolicy": follower.pull_policy,
        "args": arguments,
        "env": [
            {
                "name": KEY,
                "valueFrom": {"fieldRef": {"fieldPath": f"metadata.labels['{UID_LABEL}']"}},
            }
        ],
        "terminationMessagePolicy": "FallbackToLogsOnError",
        "securityContext": {
            "allowPrivilegeEscalation": False,
            "readOnlyRootFilesystem": True,
            "capabilities": {"drop": ["ALL"]},
        },
        "resources": {
            "requests": {"cpu": "10m", "memory": "48Mi"},
            "limits": {"cpu": "500m", "memory": "128Mi"},
        },
        "volumeMounts": [
            {"name": "mission", "mountPath": FOLDER, "readOnly": True},
            {"name": VOLUME, "mountPath": TOKENS, "readOnly": True},
        ],
    }
