"""The doctor's checks of mode cluster: programs, a kubeconfig, and whether a cluster answers."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from typing import TYPE_CHECKING

from cloudrc.cli.check import CLUSTER, Check
from cloudrc.cli.extras import missing
from cloudrc.errors import CloudrcError

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release

NEEDED = {
    "helm": "https://helm.sh/docs/intro/install",
    "kubectl": "https://kubernetes.io/docs/tasks/tools",
}
"""Programs that mode cluster calls -> where to get them."""
HELPFUL = {
    "docker": "https://docs.docker.com/engine/install",
    "kind": "https://kind.sigs.k8s.io",
}
"""Programs that make a cluster on this machine; one that is elsewhere needs neither."""
MAKE_ONE = "kind create cluster --config kind-config.yaml"
DOCKER_LIMIT = 5.0
"""For Docker's daemon to answer [s]."""


def programs() -> Iterator[Check]:
    """Look for the programs that mode cluster uses."""
    for name, where in NEEDED.items():
        path = shutil.which(name)
        if path is None:
            yield Check(name, "missing", "not in PATH", where, CLUSTER)
        else:
            yield Check(name, "ok", path, "", CLUSTER)
    for name, where in HELPFUL.items():
        path = shutil.which(name)
        if path is None:
            yield Check(name, "warn", "not in PATH", f"to make a cluster here: {where}")
        elif name == "docker" and not _docker_answers(path):
            fix = "to make a cluster here, start it: docker info says what is wrong"
            yield Check(name, "warn", f"{path}, but its daemon does not answer", fix)
        else:
            yield Check(name, "ok", path)


def cluster(context: str | None) -> Iterator[Check]:
    """Look for a kubeconfig, and ask the cluster that it leads to.

    Args:
        context: Of the kubeconfig; None for the current one.
    """
    if missing("kube"):
        return  # which is a line of its own, and without it there is no way to look
    from cloudrc.cluster.client import connect

    try:
        release = connect(context)
    except CloudrcError as error:
        found, _, fix = str(error).partition("; ")
        yield Check("kubeconfig", "missing", _short(found), fix, CLUSTER)
        return
    where = f"context {context}" if context else "its current context"
    yield Check("kubeconfig", "ok", f"{where}, namespace {release.namespace}", "", CLUSTER)
    yield _answering(release)


def _answering(release: Release) -> Check:
    from cloudrc.cluster.client import OLDEST, server_version

    oldest = ".".join(map(str, OLDEST))
    try:
        version = server_version(release)
    except CloudrcError as error:
        found, _, fix = str(error).partition("; ")
        return Check("cluster", "missing", _short(found), fix or MAKE_ONE, CLUSTER)
    found = f"Kubernetes {version[0]}.{version[1]}"
    if version < OLDEST:
        fix = f"the chart needs {oldest}: upgrade it, or {MAKE_ONE}"
        return Check("cluster", "missing", f"{found}, too old", fix, CLUSTER)
    return Check("cluster", "ok", f"{found} answers", "", CLUSTER)


def _docker_answers(path: str) -> bool:
    command = [path, "version", "--format={{.Server.Version}}"]
    try:
        return subprocess.run(command, capture_output=True, timeout=DOCKER_LIMIT).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def _short(text: str) -> str:
    return text if len(text) <= 120 else f"{text[:117]}..."
