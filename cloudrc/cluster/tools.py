"""Run kubectl and helm, turn errors of the cluster into one sentence, and find the Helm chart."""

from __future__ import annotations

import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import IO, TypeVar

from cloudrc.errors import CloudrcError, MissingPrerequisiteError

OUTAGE_MAX = 30.0
"""Longest time for which a request is repeated while the API server does not answer [s]."""
OUTAGE_PERIOD = 1.0
"""Time between two tries [s]."""
TOO_MANY_REQUESTS = 429
SERVER_ERROR = 500
"""Lowest HTTP status of a server error."""
WHERE_TO_GET = {
    "kubectl": "https://kubernetes.io/docs/tasks/tools/",
    "helm": "https://helm.sh/docs/intro/install/",
}
"""Program -> page that explains the installation."""
PACKAGE = Path(__file__).resolve().parents[1]
CHART_FILE = "Chart.yaml"

_Answer = TypeVar("_Answer")


class ClusterError(CloudrcError):
    """The cluster, or an object in it, refused or failed."""

    exit_code = 5


class UnavailableError(ClusterError):
    """The API server does not answer or is overloaded; a later try may succeed."""


class ExpiredError(CloudrcError):
    """A timeout expired."""

    exit_code = 4


@contextmanager
def explain_errors(doing: str, where: str) -> Iterator[None]:
    """Convert exceptions of the Kubernetes client to a ClusterError with one sentence.

    Args:
        doing: Action as verb and kind of object: "list Jobs".
        where: Cluster and namespace, from `Release.where`.

    Raises:
        ClusterError: In place of an exception of the client; an `UnavailableError` if a later try
            may succeed. All other exceptions stay unchanged.
    """
    from kubernetes.client.exceptions import ApiException
    from kubernetes.config.config_exception import ConfigException
    from urllib3.exceptions import HTTPError

    try:
        yield
    except ApiException as error:
        status = int(error.status or 0)
        away = status == TOO_MANY_REQUESTS or status >= SERVER_ERROR
        kind = UnavailableError if away else ClusterError
        raise kind(f"cannot {doing} {where}: {_refusal(error, doing)}") from error
    except (HTTPError, OSError) as error:
        raise UnavailableError(
            f"cannot {doing} {where}: the API server does not answer ({_root(error)}); "
            "is the cluster up? ask it: kubectl cluster-info"
        ) from error
    except ConfigException as error:  # such as a login program that fails
        raise ClusterError(f"cannot {doing} {where}: {_first_line(str(error))}") from error


def retry(ask: Callable[[], _Answer], tell: Callable[[str], None]) -> _Answer:
    """Repeat a request while the API server does not answer, for `OUTAGE_MAX` at most.

    Args:
        ask: A request that changes nothing.
        tell: Gets a line when the API server does not answer.

    Raises:
        ClusterError: The last error of `ask`.
    """
    until = None
    while True:
        try:
            return ask()
        except UnavailableError as error:
            if until is None:
                until = time.monotonic() + OUTAGE_MAX
                tell(f"{error}; trying again for {OUTAGE_MAX:g} s")
            elif time.monotonic() > until:
                raise
        time.sleep(OUTAGE_PERIOD)


def _refusal(error: Exception, doing: str) -> str:
    status, message = int(getattr(error, "status", 0) or 0), _message(error)
    if status == 401:
        return "the API server does not know you; log in to the cluster again"
    if status == 403 and "exceeded quota" in message:
        return f"{message}; free some of the namespace's quota"
    if status == 403:
        verb, _, kind = doing.partition(" ")
        return f"{message}; ask for the permission, and check it: kubectl auth can-i {verb} {kind}"
    return message or f"the API server answered {status}"


def _message(error: Exception) -> str:
    """Extract the API server's message from an error, as one line."""
    try:
        message = json.loads(getattr(error, "body", "") or "")["message"]
    except (ValueError, KeyError, TypeError):
        message = getattr(error, "reason", "") or ""
    return " ".join(str(message).split())


def _root(error: BaseException) -> str:
    """Return the innermost cause; the outer exceptions only report repeated tries."""
    reason = getattr(error, "reason", None)
    if isinstance(reason, BaseException):
        return _root(reason)
    text = _first_line(str(error))
    return text.rpartition(": ")[2] or type(error).__name__


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]


def program(name: str) -> str:
    """Find a program on the PATH.

    Raises:
        MissingPrerequisiteError: If the program is not installed; the message names a page that
            explains the installation.
    """
    path = shutil.which(name)
    if path is None:
        raise MissingPrerequisiteError(f"{name} is not installed; install it: {WHERE_TO_GET[name]}")
    return path


def run(
    name: str,
    arguments: Sequence[str],
    *,
    timeout: float,
    given: str = "",
    stdout: IO[bytes] | None = None,
) -> str:
    """Run a program to its end.

    Args:
        name: "kubectl" or "helm".
        arguments: Arguments of the program.
        timeout: Time limit [s].
        given: Text for the program's standard input.
        stdout: File for the program's output; None to return the output.

    Returns:
        The program's output; "" if `stdout` is given.

    Raises:
        ClusterError: If the program fails; the message is that of the program.
        ExpiredError: If the program takes longer than `timeout`.
        MissingPrerequisiteError: If the program is not installed.
    """
    command = [program(name), *arguments]
    target = subprocess.PIPE if stdout is None else stdout
    try:
        done = subprocess.run(
            command, input=given.encode(), stdout=target, stderr=subprocess.PIPE, timeout=timeout
        )
    except subprocess.TimeoutExpired as error:
        raise ExpiredError(f"'{_short(name, arguments)}' took more than {timeout:g} s") from error
    if done.returncode != 0:
        message = last_words(done.stderr.decode(errors="replace"))
        raise ClusterError(f"'{_short(name, arguments)}' failed: {message}")
    return (done.stdout or b"").decode(errors="replace")


def last_words(stderr: str) -> str:
    """Extract a program's error message as one line, without warnings and log lines."""
    lines = [" ".join(line.split()) for line in stderr.splitlines() if line.strip()]
    first = next((i for i, line in enumerate(lines) if line.lower().startswith("error")), None)
    text = " ".join(lines[first:] if first is not None else lines[-1:])
    return text.removeprefix("Error: ").removeprefix("error: ") or "no error message"


def _short(name: str, arguments: Sequence[str]) -> str:
    """Shorten a command to its program, verb and object."""
    words = [word for word in arguments if not word.startswith("-")][:2]
    return " ".join([name, *words])


def chart_folder(package: Path = PACKAGE) -> Path:
    """Find the Helm chart.

    Args:
        package: Folder of the package `cloudrc`.

    Raises:
        MissingPrerequisiteError: If the chart is missing.
    """
    # A wheel has the chart inside the package; a repository has it beside the package.
    places = (package / "_chart", package.parent / "charts" / "cloudrc")
    for place in places:
        if (place / CHART_FILE).is_file():
            return place
    raise MissingPrerequisiteError(
        f"the Helm chart is in neither of {places[0]} and {places[1]}; install cloudrc again: "
        "pip install --force-reinstall cloudrc"
    )
