# SPDX-License-Identifier: Apache-2.0

"""Select a Helm release of cloudrc, send requests to its Kubernetes cluster, run kubectl and helm.

Every error of the cluster or of a program becomes a message of one sentence.
"""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import IO, Any

from cloudrc.base.errors import CloudrcError, MissingPrerequisiteError, TimedOutError, to_one_line
from cloudrc.cluster import DEFAULT_RELEASE

COMPONENTS = ("world", "cloud")
"""Components of a release that have a pod of their own."""
REQUEST_TIMEOUT = 15.0
"""Time limit for one request to the API server [s]."""
RETRIES: dict[str, Any] = {
    **{"total": 6, "connect": 4, "read": 1, "other": 4},
    **{"backoff_factor": 0.5, "respect_retry_after_header": False},
}
"""How often urllib3 repeats a request: for 31 s while the API server is overloaded, for 7 s after
a failed connection or a TLS error, and once if the server does not answer. A request to create an
object is repeated only after a failed connection or a TLS error."""
BUSY = (429, 500, 502, 503, 504)
"""HTTP status codes after which the same request may succeed later."""
PATIENCE, PAUSE = 60.0, 2.0
"""Time for which a patient release sends a request again that gets no answer, and between two
attempts [s]."""
PROGRAM_LIMIT = 120.0
"""Time limit for one command of kubectl or helm [s], such as the copy of a recording."""
PACKAGE = Path(__file__).resolve().parents[1]
_KINDS = {
    **{
        name: ("CoreV1Api", name[:-1])
        for name in ("pods", "secrets", "events", "namespaces", "nodes")
    },
    "persistentvolumeclaims": ("CoreV1Api", "persistent_volume_claim"),
    "storageclasses": ("StorageV1Api", "storage_class"),
    "networkpolicies": ("NetworkingV1Api", "network_policy"),
    "configmaps": ("CoreV1Api", "config_map"),
    "resourcequotas": ("CoreV1Api", "resource_quota"),
    "pods/log": ("CoreV1Api", "pod_log"),
    "selfsubjectaccessreviews": ("AuthorizationV1Api", "self_subject_access_review"),
    "jobs": ("BatchV1Api", "job"),
    "deployments": ("AppsV1Api", "deployment"),
    "statefulsets": ("AppsV1Api", "stateful_set"),
}
"""Kind of objects -> class of the Kubernetes client, and the name of the kind in its methods."""
OF_CLUSTER = ("namespaces", "nodes", "storageclasses", "selfsubjectaccessreviews")
"""Kinds whose objects are in no namespace."""


class ClusterError(CloudrcError):
    """Report that the cluster has denied a request, or that an object in the cluster failed."""

    exit_code = 5


class NotFoundError(ClusterError):
    """Report that the cluster does not have an object."""


class ExistsError(ClusterError):
    """Report that the cluster already has an object of this name."""


class ExpiredError(ClusterError):
    """Report that the API server no longer has the changes since a version of an object."""


class NoAnswerError(ClusterError):
    """Report that the API server does not answer; what runs in the cluster goes on."""


ERRORS: dict[int, type[ClusterError]] = {
    **{404: NotFoundError, 409: ExistsError, 410: ExpiredError},
    **dict.fromkeys(BUSY, NoAnswerError),
}
"""HTTP status code -> error."""


@dataclass(frozen=True)
class Release:
    """One release of the chart: one robot and its cloud, or a fleet."""

    context: str | None  # of the kubeconfig; None: the current one
    namespace: str | None  # None (with kubectl only): that of the context
    name: str  # of the Helm release
    robot: int | None = None  # number of the robot that is meant in a fleet
    # Of a patient release: receives the error of a request that is sent again.
    notify: Callable[[str], None] | None = field(default=None, compare=False)

    def __str__(self) -> str:
        return f"release '{self.name}' {self.where}"

    @property
    def where(self) -> str:
        """Namespace and context as a phrase for messages."""
        context = f" of context '{self.context}'" if self.context else ""
        return f"in namespace '{self.namespace}'{context}"

    @property
    def flags(self) -> list[str]:
        """Flags that select context and namespace in kubectl."""
        given = {"context": self.context, "namespace": self.namespace}
        return [f"--{name}={value}" for name, value in given.items() if value]

    @property
    def kubectl(self) -> str:
        """The beginning of a command of kubectl for messages: "kubectl" and its flags."""
        return " ".join(["kubectl", *self.flags])

    @property
    def helm_flags(self) -> list[str]:
        """Flags that select context and namespace in helm."""
        return [flag.replace("--context", "--kube-context") for flag in self.flags]

    def helm_upgrade(self, *settings: str) -> str:
        """Return the helm command that changes `settings` and keeps all other values."""
        sets = [f"--set {each}" for each in settings]
        words = [self.name, "charts/cloudrc", *self.helm_flags, "--reset-then-reuse-values", *sets]
        return f"helm upgrade {' '.join(words)}"

    def labels(self, component: str) -> dict[str, str]:
        """Return the Kubernetes labels of a component: "world", "cloud" or "mission"."""
        return {
            "app.kubernetes.io/name": "cloudrc",
            "app.kubernetes.io/instance": self.name,
            "app.kubernetes.io/component": component,
        }

    @cached_property
    def client(self) -> Any:
        """Client of the Kubernetes API with the kubeconfig's login."""
        from kubernetes import client, config
        from urllib3 import Retry

        logging.getLogger("urllib3").setLevel(logging.ERROR)  # it prints a warning per repetition
        configuration = client.Configuration()
        with explain_errors("read the kubeconfig", self.where):
            load: Any = config.load_kube_config  # not annotated
            load(context=self.context, client_configuration=configuration)
        configuration.retries = Retry(**RETRIES, status_forcelist=BUSY, raise_on_status=False)
        return client.ApiClient(configuration)

    def request(self, verb: str, kind: str, **arguments: Any) -> Any:
        """Send a request about objects in the release's namespace; return the client's answer.

        A patient release sends a request without an answer again.

        Args:
            verb: "list" or, in all namespaces, "list all", which return a list; or "get", "create"
                or "delete".
            kind: Kind of the objects, such as "pods".
            arguments: Arguments of the Kubernetes client, such as `name`.

        Raises:
            ClusterError: If the API server denies it or does not answer.
        """
        until, failed = time.monotonic() + PATIENCE, False
        while True:
            try:
                return self._request(verb, kind, **arguments)
            except NoAnswerError as error:
                if self.notify is None or time.monotonic() > until:
                    raise
                if not failed:
                    self.notify(f"{error}; trying again for {PATIENCE:g} s")
                failed = True
            except (ExistsError, NotFoundError):
                # A request without an answer may have created or deleted the object.
                if failed and verb == "create":
                    return self._request("get", kind, name=arguments["body"]["metadata"]["name"])
                if failed and verb == "delete":
                    return None
                raise
            time.sleep(PAUSE)

    def _request(self, verb: str, kind: str, **arguments: Any) -> Any:
        """Send a request once; its arguments are those of `request`."""
        from kubernetes import client

        name, noun = _KINDS[kind]
        scope, where = {"namespace": self.namespace}, self.where
        method = f"{'read' if verb == 'get' else verb}_namespaced_{noun}"
        if verb == "list all":
            scope, where = {}, "in all namespaces"
            method = f"list_{noun}_for_all_namespaces"
        elif kind in OF_CLUSTER:
            scope, method = {}, method.replace("_namespaced", "")
        call = getattr(getattr(client, name)(self.client), method)
        with explain_errors(f"{verb.partition(' ')[0]} {kind}", where):
            answer = call(_request_timeout=REQUEST_TIMEOUT, **scope, **arguments)
        return answer.items if verb.startswith("list") else answer

    def patient(self, tell: Callable[[str], None]) -> Release:
        """Return this release with patience, for what goes on in the cluster without a command.

        A request that gets no answer is sent again for `PATIENCE`; `tell` receives its error.
        """
        return replace(self, notify=tell)

    def find(self, kind: str, component: str) -> list[Any]:
        """List the objects of one kind, such as "pods", that belong to a component."""
        selector = ",".join(f"{name}={value}" for name, value in self.labels(component).items())
        found: list[Any] = self.request("list", kind, label_selector=selector)
        return found


def connect(
    context: str | None = None, namespace: str | None = None, release: str = DEFAULT_RELEASE
) -> Release:
    """Select a release by the kubeconfig, without a request to the cluster.

    The defaults are the current context, and the namespace of the context or "default".

    Raises:
        MissingPrerequisiteError: If there is no valid kubeconfig, or if the context is unknown.
    """
    from kubernetes import config

    try:
        contexts: Any = config.list_kube_config_contexts  # not annotated
        known, current = contexts()
    except Exception as error:  # the client raises many kinds for a broken kubeconfig
        raise MissingPrerequisiteError(
            f"no cluster is configured ({' '.join(str(error).split())})",
            fix="set KUBECONFIG, or make a cluster: kind create cluster --config kind-config.yaml",
        ) from error
    if context is not None:
        by_name = {each["name"]: each for each in known}
        if context not in by_name:
            names = ", ".join(sorted(by_name))
            text = f"no context '{context}' in the kubeconfig"
            raise MissingPrerequisiteError(text, fix=f"known: {names}")
        current = by_name[context]
    inherited = (current or {}).get("context", {}).get("namespace")
    return Release(context, namespace or inherited or "default", release)


@contextmanager
def explain_errors(doing: str, where: str) -> Iterator[None]:
    """Convert exceptions of the Kubernetes client to a ClusterError with a message of one sentence.

    Args:
        doing: The failed action as verb and kind of object, such as "list jobs".
        where: Cluster and namespace, from `Release.where`.
    """
    from kubernetes.client.exceptions import ApiException
    from kubernetes.config.config_exception import ConfigException
    from urllib3.exceptions import HTTPError

    try:
        yield
    except ApiException as error:
        kind = ERRORS.get(error.status, ClusterError)
        text, fix = _refusal(error, doing)
        raise kind(f"cannot {doing} {where}: {text}", fix=fix) from error
    except ValueError as error:  # of the client, which checks an object before it sends it
        words = to_one_line(str(error))
        text = words.partition(" body.")[2].partition(" [type=")[0] or words
        raise ClusterError(f"cannot {doing} {where}: {text}") from error
    except (HTTPError, OSError) as error:
        why = str(getattr(error, "reason", error)).rpartition(": ")[2]  # after repeated attempts
        text = f"cannot {doing} {where}: the API server does not answer ({why})"
        fix = "is the cluster up? ask it: kubectl cluster-info"
        raise NoAnswerError(text, fix=fix) from error
    except ConfigException as error:  # such as a missing certificate file
        raise ClusterError(f"cannot {doing} {where}: {str(error).partition(chr(10))[0]}") from error


def _refusal(error: Any, doing: str) -> tuple[str, str]:
    """Return why the API server has denied a request, and what to do."""
    try:
        message = json.loads(error.body)["message"]
    except (ValueError, KeyError, TypeError):
        message = error.reason or f"the API server answered {error.status}"
    if error.status == 401:
        return "the API server does not know you", "log in to the cluster again"
    message = " ".join(str(message).split())
    is_of_user = " cannot " in message  # not of the object, such as a quota
    return message, f"check your permission: kubectl auth can-i {doing}" * is_of_user


def program(name: str) -> str:
    """Find a program on the PATH; raise MissingPrerequisiteError if it is missing."""
    path = shutil.which(name)
    if path is None:
        fix = "'cloudrc doctor --mode cluster' says how to install it"
        raise MissingPrerequisiteError(f"{name} is not installed", fix=fix)
    return path


def run(
    name: str, arguments: Sequence[str], *, given: str = "", stdout: IO[bytes] | None = None
) -> str:
    """Run kubectl or helm with the standard input `given`, and return the program's output.

    With a file `stdout`, the output goes to the file, and the result is "".

    Raises:
        ClusterError: If the program fails; the message is that of the program.
        TimedOutError: If the program takes longer than `PROGRAM_LIMIT`.
        MissingPrerequisiteError: If the program is not installed.
    """
    command = [program(name), *arguments]
    short = " ".join([name, *[word for word in arguments if not word.startswith("-")][:2]])
    how: dict[str, Any] = {"stdout": stdout or subprocess.PIPE, "stderr": subprocess.PIPE}
    try:
        done = subprocess.run(command, input=given.encode(), timeout=PROGRAM_LIMIT, **how)
    except subprocess.TimeoutExpired as error:
        raise TimedOutError(f"'{short}' took more than {PROGRAM_LIMIT:g} s") from error
    if done.returncode != 0:
        raise ClusterError(f"'{short}' failed: {last_words(done.stderr)}")
    return (done.stdout or b"").decode(errors="replace")


def last_words(stderr: bytes) -> str:
    """Extract the error message from a program's standard error, as one line."""
    text = stderr.decode(errors="replace")
    lines = [" ".join(line.split()) for line in text.splitlines() if line.strip()]
    first = next((i for i, line in enumerate(lines) if line.lower().startswith("error")), -1)
    message = " ".join(lines[first:]).removeprefix("Error: ").removeprefix("error: ")
    if "error dialing backend" in message:  # the API server reaches no kubelet
        message += "; the pod's node does not answer, see: kubectl get nodes"
    return message or "no error message"


def chart_folder(package: Path = PACKAGE) -> Path:
    """Find the folder of the Helm chart, in an installed package or in a repository.

    Raises:
        MissingPrerequisiteError: If the chart is missing.
    """
    places = (package / "_chart", package.parent / "charts" / "cloudrc")
    for place in places:
        if (place / "Chart.yaml").is_file():
            return place
    raise MissingPrerequisiteError(
        f"the Helm chart is not in {places[0]}", fix="install cloudrc again"
    )
