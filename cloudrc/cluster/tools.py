"""The programs that are called rather than rebuilt: arguments of kubectl or helm in, text out.

What goes wrong with a cluster, in one sentence: an exception comes in, a cause goes out.

Where the Helm chart is: in an installed wheel, or in the repository beside the package.
"""

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
"""How long the API server may be away while something is waited for: it may choose a leader [s]."""
OUTAGE_PERIOD = 1.0
"""Between two tries [s]."""
TOO_MANY_REQUESTS = 429
SERVER_ERROR = 500
"""This HTTP status and all above it."""

_Answer = TypeVar("_Answer")


class ClusterError(CloudrcError):
    """The cluster, or something in it, refused or failed."""

    exit_code = 5


class AwayError(ClusterError):
    """The API server does not answer, or has no time: it may a moment later."""


class WaitedTooLongError(CloudrcError):
    """Something did not happen within the time that was allowed for it."""

    exit_code = 4


@contextmanager
def explained(doing: str, where: str) -> Iterator[None]:
    """Turn the Kubernetes client's exceptions into one sentence.

    Args:
        doing: What was tried, as a verb: "list Jobs".
        where: Cluster and namespace, as `Release.where` says it.

    Raises:
        ClusterError: In place of what the client raises; other exceptions pass. It is an
            `AwayError` where it may pass by waiting.
    """
    from kubernetes.client.exceptions import ApiException
    from kubernetes.config.config_exception import ConfigException
    from urllib3.exceptions import HTTPError

    try:
        yield
    except ApiException as error:
        status = int(error.status or 0)
        away = status == TOO_MANY_REQUESTS or status >= SERVER_ERROR
        kind = AwayError if away else ClusterError
        raise kind(f"cannot {doing} {where}: {_refusal(error, doing)}") from error
    except (HTTPError, OSError) as error:
        raise AwayError(
            f"cannot {doing} {where}: the API server does not answer ({_root(error)}); "
            "is the cluster up? ask it: kubectl cluster-info"
        ) from error
    except ConfigException as error:  # such as a login program that fails
        raise ClusterError(f"cannot {doing} {where}: {_first_line(str(error))}") from error


def insist(ask: Callable[[], _Answer], tell: Callable[[str], None]) -> _Answer:
    """Ask again while the API server is away, for `OUTAGE_MAX` at most.

    Args:
        ask: Reads something, and changes nothing.
        tell: Gets a line when the API server is away.

    Raises:
        ClusterError: What `ask` raises, if it does not pass.
    """
    until = None
    while True:
        try:
            return ask()
        except AwayError as error:
            if until is None:
                until = time.monotonic() + OUTAGE_MAX
                tell(f"{error}; trying again for {OUTAGE_MAX:g} s")
            elif time.monotonic() > until:
                raise
        time.sleep(OUTAGE_PERIOD)


def _refusal(error: Exception, doing: str) -> str:
    status, said = int(getattr(error, "status", 0) or 0), _message(error)
    if status == 401:
        return "the API server does not know you; log in to the cluster again"
    if status == 403 and "exceeded quota" in said:
        return f"{said}; free some of the namespace's quota"
    if status == 403:
        verb, _, kind = doing.partition(" ")
        return f"{said}; ask for the permission, and check it: kubectl auth can-i {verb} {kind}"
    return said or f"the API server answered {status}"


def _message(error: Exception) -> str:
    """What the API server says about the error, in one line."""
    try:
        said = json.loads(getattr(error, "body", "") or "")["message"]
    except (ValueError, KeyError, TypeError):
        said = getattr(error, "reason", "") or ""
    return " ".join(str(said).split())


def _root(error: BaseException) -> str:
    """The innermost reason: the outer ones only say that something was tried again."""
    reason = getattr(error, "reason", None)
    if isinstance(reason, BaseException):
        return _root(reason)
    text = _first_line(str(error))
    return text.rpartition(": ")[2] or type(error).__name__


def _first_line(text: str) -> str:
    return text.strip().partition("\n")[0]


WHERE_TO_GET = {
    "kubectl": "https://kubernetes.io/docs/tasks/tools/",
    "helm": "https://helm.sh/docs/intro/install/",
}


def program(name: str) -> str:
    """Find a program.

    Raises:
        MissingPrerequisiteError: If it is not installed; says where it is to be had.
    """
    path = shutil.which(name)
    if path is None:
        raise MissingPrerequisiteError(f"{name} is not installed; get it: {WHERE_TO_GET[name]}")
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
        arguments: Its arguments.
        timeout: How long it may take [s].
        given: What it reads from its standard input.
        stdout: A file for what it writes; default: it is returned.

    Returns:
        What it wrote; "" if that went into a file.

    Raises:
        ClusterError: If it fails; with what it said.
        WaitedTooLongError: If it takes too long.
        MissingPrerequisiteError: If it is not installed.
    """
    command = [program(name), *arguments]
    target = subprocess.PIPE if stdout is None else stdout
    try:
        done = subprocess.run(
            command, input=given.encode(), stdout=target, stderr=subprocess.PIPE, timeout=timeout
        )
    except subprocess.TimeoutExpired as error:
        raise WaitedTooLongError(
            f"'{_short(name, arguments)}' took more than {timeout:g} s"
        ) from error
    if done.returncode != 0:
        said = last_words(done.stderr.decode(errors="replace"))
        raise ClusterError(f"'{_short(name, arguments)}' failed: {said}")
    return (done.stdout or b"").decode(errors="replace")


def last_words(stderr: str) -> str:
    """Put what a program complained about into one line, without warnings and log lines."""
    lines = [" ".join(line.split()) for line in stderr.splitlines() if line.strip()]
    first = next((i for i, line in enumerate(lines) if line.lower().startswith("error")), None)
    wanted = lines[first:] if first is not None else lines[-1:]
    text = " ".join(wanted)
    return text.removeprefix("Error: ").removeprefix("error: ") or "it left no message"


def _short(name: str, arguments: Sequence[str]) -> str:
    """The command as a person would say it: its verb and what it is about."""
    words = [word for word in arguments if not word.startswith("-")][:2]
    return " ".join([name, *words])


PACKAGE = Path(__file__).resolve().parents[1]
CHART_FILE = "Chart.yaml"


def chart_folder(package: Path = PACKAGE) -> Path:
    """Find the chart.

    Args:
        package: The folder `cloudrc`, wherever it is installed.

    Raises:
        MissingPrerequisiteError: If it is in neither place.
    """
    # A wheel carries the chart inside the package; an editable install leaves it where it is.
    places = (package / "_chart", package.parent / "charts" / "cloudrc")
    for place in places:
        if (place / CHART_FILE).is_file():
            return place
    raise MissingPrerequisiteError(
        f"the Helm chart is in neither of {places[0]} and {places[1]}; install cloudrc again: "
        "pip install --force-reinstall cloudrc"
    )
