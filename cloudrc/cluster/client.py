"""Select a release by context, namespace and name, and provide Kubernetes clients for it."""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from cloudrc.cluster.tools import ClusterError, explain_errors
from cloudrc.errors import MissingPrerequisiteError

DEFAULT_RELEASE = "cloudrc"
REQUEST_TIMEOUT = 15.0
"""Time limit for one request to the API server [s]."""
OLDEST = (1, 29)
"""Oldest Kubernetes version that the chart supports, as kubeVersion in Chart.yaml."""
ANSWER_LIMIT = 5.0
"""Time limit for the API server to return its version [s]."""
COMPONENT = "experiment"
"""Label `component` of the experiment's ConfigMap."""
FILE = "experiment.yaml"
"""Key of the experiment in the ConfigMap of a release."""


@dataclass(frozen=True)
class Release:
    """One release of the chart: one robot and its cloud.

    Attributes:
        context: Context of the kubeconfig; None for the current context.
        namespace: Namespace of the release.
        name: Name of the Helm release.
    """

    context: str | None
    namespace: str
    name: str

    @property
    def where(self) -> str:
        """Namespace and context in words, for messages."""
        context = f" of context '{self.context}'" if self.context else ""
        return f"in namespace '{self.namespace}'{context}"

    @property
    def flags(self) -> list[str]:
        """Flags of kubectl that select context and namespace."""
        context = [f"--context={self.context}"] if self.context else []
        return [*context, f"--namespace={self.namespace}"]

    @property
    def helm_flags(self) -> list[str]:
        """Flags of helm that select context and namespace."""
        context = [f"--kube-context={self.context}"] if self.context else []
        return [*context, f"--namespace={self.namespace}"]

    @property
    def cloudrc_flags(self) -> list[str]:
        """Flags of cloudrc that select context, namespace and release."""
        return [*self.flags, f"--release={self.name}"]

    def selector(self, component: str) -> str:
        """Return the label selector of a component of this release: "world", "cloud", "mission"."""
        return (
            f"app.kubernetes.io/name=cloudrc,app.kubernetes.io/instance={self.name},"
            f"app.kubernetes.io/component={component}"
        )

    @cached_property
    def _client(self) -> Any:
        from kubernetes import client, config

        configuration = client.Configuration()
        with explain_errors("read the kubeconfig", self.where), _login_errors(self.where):
            load: Any = config.load_kube_config  # not annotated
            load(context=self.context, client_configuration=configuration)
        configuration.retries = False  # callers repeat a request themselves, with a message
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
def _login_errors(where: str) -> Iterator[None]:
    """Raise an error if the kubeconfig's login program fails, which the client only logs.

    Raises:
        MissingPrerequisiteError: With the client's message, which names the program.
    """
    messages: list[str] = []

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            messages.append(" ".join(record.getMessage().split()))

    # The client logs to the root logger, which prints when it has no handler. The NullHandler
    # stays, because the client logs again after a token has expired.
    root, listener = logging.getLogger(), Listener(logging.ERROR)
    if not any(isinstance(handler, logging.NullHandler) for handler in root.handlers):
        root.addHandler(logging.NullHandler())
    root.addHandler(listener)
    try:
        yield
    finally:
        root.removeHandler(listener)
    if messages:
        raise MissingPrerequisiteError(
            f"cannot log in to the cluster {where}: the kubeconfig's login program failed: "
            f"{messages[0]}; install it, or run it by hand to see why"
        )


def connect(
    context: str | None = None, namespace: str | None = None, release: str = DEFAULT_RELEASE
) -> Release:
    """Select a release by the kubeconfig, without a request to the cluster.

    Args:
        context: Value of `--context`; None for the current context.
        namespace: Value of `-n`; None for the namespace of the context, or "default".
        release: Name of the Helm release.

    Raises:
        MissingPrerequisiteError: If there is no valid kubeconfig or no such context.
    """
    from kubernetes import config

    try:
        contexts: Any = config.list_kube_config_contexts  # not annotated
        known, current = contexts()
    except Exception as error:  # the client raises many kinds for a broken kubeconfig
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
    return f"no context '{context}' in the kubeconfig; known: {names}; choose with --context"


def server_version(release: Release) -> tuple[int, int]:
    """Ask the API server for its version.

    Returns:
        Major and minor version.

    Raises:
        ClusterError: If the API server does not answer, or refuses the request.
    """
    with explain_errors("get the version", release.where):
        code = release.version.get_code(_request_timeout=ANSWER_LIMIT)
    # The minor version of some vendors has a suffix: "29+".
    found = [re.match(r"\d+", str(text)) for text in (code.major, code.minor)]
    if not all(found):
        raise ClusterError(
            f"the API server {release.where} has the unknown version {code.git_version}"
        )
    major, minor = (int(match.group()) for match in found if match)
    return major, minor


def experiment_text(release: Release) -> str:
    """Read the experiment of a release as YAML; "" if its ConfigMap is missing.

    Raises:
        ClusterError: If the ConfigMap cannot be read.
    """
    with explain_errors("list configmaps", release.where):
        found = release.core.list_namespaced_config_map(
            release.namespace,
            label_selector=release.selector(COMPONENT),
            _request_timeout=REQUEST_TIMEOUT,
        ).items
    return next((str((each.data or {}).get(FILE, "")) for each in found), "")
