"""What goes wrong with a cluster, in one sentence: an exception comes in, a cause goes out."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager

from cloudrc.errors import CloudrcError


class ClusterError(CloudrcError):
    """The cluster, or something in it, refused or failed."""

    exit_code = 5


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
        ClusterError: In place of what the client raises; other exceptions pass.
    """
    from kubernetes.client.exceptions import ApiException
    from kubernetes.config.config_exception import ConfigException
    from urllib3.exceptions import HTTPError

    try:
        yield
    except ApiException as error:
        raise ClusterError(f"cannot {doing} {where}: {_refusal(error, doing)}") from error
    except (HTTPError, OSError) as error:
        raise ClusterError(
            f"cannot {doing} {where}: the API server does not answer ({_root(error)}); "
            "is the cluster up? ask it: kubectl cluster-info"
        ) from error
    except ConfigException as error:  # such as a login program that fails
        raise ClusterError(f"cannot {doing} {where}: {_first_line(str(error))}") from error


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
