"""Which cluster, which namespace, which release: flags come in, clients of that place go out.

How old a cluster is: a place comes in, the version of its API server goes out.

The experiment of a release: its ConfigMap is found, the text in it goes out as it was given.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cloudrc.cluster.tools import ClusterError, explained
from cloudrc.errors import MissingPrerequisiteError

DEFAULT_RELEASE = "cloudrc"
REQUEST_TIMEOUT = 15.0
"""For the API server to answer one request [s]."""


@dataclass(frozen=True)
class Release:
    """One release of the chart: one robot and its cloud.

    Attributes:
        context: Of the kubeconfig; None for its current one.
        namespace: Where the release is.
        name: Of the release, as Helm knows it.
    """

    context: str | None
    namespace: str
    name: str

    @property
    def where(self) -> str:
        """The place in words, for messages."""
        context = f" of context '{self.context}'" if self.context else ""
        return f"in namespace '{self.namespace}'{context}"

    @property
    def flags(self) -> list[str]:
        """What kubectl has to be told to look at the same place."""
        context = [f"--context={self.context}"] if self.context else []
        return [*context, f"--namespace={self.namespace}"]

    @property
    def helm_flags(self) -> list[str]:
        """Likewise for helm."""
        context = [f"--kube-context={self.context}"] if self.context else []
        return [*context, f"--namespace={self.namespace}"]

    @property
    def cloudrc_flags(self) -> list[str]:
        """Likewise for cloudrc."""
        return [*self.flags, f"--release={self.name}"]

    def selector(self, component: str) -> str:
        """Select by label what belongs to a part of this release: "world", "cloud", "mission"."""
        return (
            f"app.kubernetes.io/name=cloudrc,app.kubernetes.io/instance={self.name},"
            f"app.kubernetes.io/component={component}"
        )

    @cached_property
    def _client(self) -> Any:
        from kubernetes import client, config

        configuration = client.Configuration()
        with explained("read the kubeconfig", self.where), _logging_in(self.where):
            load: Any = config.load_kube_config  # not annotated
            load(context=self.context, client_configuration=configuration)
        configuration.retries = False  # the caller repeats what is worth repeating, and says so
        return client.ApiClient(configuration)

    @cached_property
    def core(self) -> Any:
        """Client of pods, Services, ConfigMaps."""
        from kubernetes import client

        return client.CoreV1Api(self._client)

    @cached_property
    def batch(self) -> Any:
        """Client of Jobs."""
        from kubernetes import client

        return client.BatchV1Api(self._client)

    @cached_property
    def version(self) -> Any:
        """Client of the API server's own version."""
        from kubernetes import client

        return client.VersionApi(self._client)

    @cached_property
    def apps(self) -> Any:
        """Client of Deployments."""
        from kubernetes import client

        return client.AppsV1Api(self._client)


@contextmanager
def _logging_in(where: str) -> Iterator[None]:
    """Raise what the client only logs: that a login program did not run or gave nothing.

    Raises:
        MissingPrerequisiteError: With the client's words, which name the program.
    """
    heard: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            heard.append(" ".join(record.getMessage().split()))

    # It logs to the root logger, which prints by itself once it is used without a handler; and
    # again when a token has expired, so that one handler stays.
    root, listener = logging.getLogger(), Listener(logging.ERROR)
    if not any(isinstance(handler, logging.NullHandler) for handler in root.handlers):
        root.addHandler(logging.NullHandler())
    root.addHandler(listener)
    try:
        yield
    finally:
        root.removeHandler(listener)
    if heard:
        raise MissingPrerequisiteError(
            f"cannot log in to the cluster {where}: the kubeconfig's login program failed: "
            f"{heard[0]}; install it, or run it by hand to see why"
        )


def connect(
    context: str | None = None, namespace: str | None = None, release: str = DEFAULT_RELEASE
) -> Release:
    """Find a place in the kubeconfig; nothing is sent to the cluster yet.

    Args:
        context: As the flag `--context`; None for the current one.
        namespace: As the flag `-n`; None for the context's own, or "default".
        release: Name of the Helm release.

    Raises:
        MissingPrerequisiteError: If there is no usable kubeconfig or no such context.
    """
    from kubernetes import config

    try:
        contexts: Any = config.list_kube_config_contexts  # not annotated
        known, current = contexts()
    except Exception as error:  # a kubeconfig can be broken in any way, and the client tells little
        raise MissingPrerequisiteError(
            f"no cluster is configured ({' '.join(str(error).split())}); set KUBECONFIG, or make "
            "a cluster: kind create cluster --config kind-config.yaml"
        ) from error
    if context is not None:
        current = next((c for c in known if c["name"] == context), None)
        if current is None:
            raise MissingPrerequisiteError(_unknown_context(context, [c["name"] for c in known]))
    inherited = (current or {}).get("context", {}).get("namespace")
    return Release(context, namespace or inherited or "default", release)


def _unknown_context(context: str, known: Sequence[str]) -> str:
    names = ", ".join(sorted(known)) or "none"
    return f"no context '{context}' in the kubeconfig; there are: {names}; choose with --context"


OLDEST = (1, 29)
"""Kubernetes that the chart runs on; the same as kubeVersion in its Chart.yaml."""
ANSWER_LIMIT = 5.0
"""For the API server to say its version [s]."""


def server_version(release: Release) -> tuple[int, int]:
    """Ask the API server for its version.

    Returns:
        Major and minor.

    Raises:
        ClusterError: If it does not answer, or refuses.
    """
    with explained("get the version", release.where):
        code = release.version.get_code(_request_timeout=ANSWER_LIMIT)
    # Minor is "29+" where the cluster's vendor has added something.
    found = [re.match(r"\d+", str(text)) for text in (code.major, code.minor)]
    if not all(found):
        raise ClusterError(f"the API server {release.where} calls itself {code.git_version}")
    major, minor = (int(match.group()) for match in found if match)
    return major, minor


COMPONENT = "experiment"
FILE = "experiment.yaml"


def experiment_text(release: Release) -> str:
    """Read what a release was told to fly, as YAML; "" if it does not say.

    Raises:
        ClusterError: If the ConfigMap cannot be read.
    """
    with explained("list configmaps", release.where):
        found = release.core.list_namespaced_config_map(
            release.namespace,
            label_selector=release.selector(COMPONENT),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    return next((str((each.data or {}).get(FILE, "")) for each in found), "")
