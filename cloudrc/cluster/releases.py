"""Find the releases of cloudrc: the only one of a namespace, or all of a cluster."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from cloudrc.cluster.client import ClusterError, NotFoundError, Release
from cloudrc.errors import BadInputError

INSTANCE = "app.kubernetes.io/instance"
"""Label with the name of the release."""
SELECTOR = "app.kubernetes.io/name=cloudrc,app.kubernetes.io/component=cloud"
"""Selects the one Deployment that each release has for its cloud."""


class Place(NamedTuple):
    """Where a release is."""

    namespace: str
    name: str


def find_releases(release: Release, *, everywhere: bool) -> list[Place]:
    """List the releases in the namespace of `release`, or in all namespaces, sorted.

    Raise a ClusterError if the user may not list Deployments there.
    """
    verb = "list all" if everywhere else "list"
    found = release.request(verb, "deployments", label_selector=SELECTOR)
    return sorted(
        Place(each.metadata.namespace, (each.metadata.labels or {}).get(INSTANCE, ""))
        for each in found
    )


def only_release(release: Release) -> Release:
    """Return the only release in the namespace of `release`; its name does not matter.

    Raises:
        BadInputError: If the namespace has several releases.
        ClusterError: If the namespace does not exist, or has no release.
    """
    places = find_releases(release, everywhere=False)
    if len(places) == 1:
        return replace(release, name=places[0].name)
    if places:
        raise several_releases(release, [place.name for place in places])
    raise no_release(release, f"no release {release.where}")


def several_releases(release: Release, names: list[str]) -> BadInputError:
    """Return the error that a namespace has several releases."""
    return BadInputError(
        f"several releases {release.where}: {', '.join(sorted(names))}; name one: --release NAME"
    )


def no_release(release: Release, what: str = "") -> ClusterError:
    """Return the error that a release does not exist; it names those that exist.

    `what` is the beginning of its text, by default "no release 'NAME' in namespace ...".
    """
    what = what or f"no release '{release.name}' {release.where}"
    if not _namespace_exists(release):
        what = f"no namespace '{release.namespace}'{release.of_context}"
    known = _known(release)
    if known:
        return ClusterError(f"{what}; there are: {known}; name one: --release NAME -n NAMESPACE")
    flags = " ".join(release.helm_flags)
    return ClusterError(
        f"{what}; install it: helm install {release.name} charts/cloudrc {flags}, "
        "or name another: --release NAME -n NAMESPACE"
    )


def _known(release: Release) -> str:
    """Name the releases that the user may see, at most ten; "" if there is none."""
    places: list[Any] = []
    for everywhere in (True, False):
        try:
            places = find_releases(release, everywhere=everywhere)
            break
        except ClusterError:  # no right to list all namespaces
            continue
    shown = [f"'{place.name}' in namespace '{place.namespace}'" for place in places]
    return ", ".join([*shown[:10], *(["..."] if len(shown) > 10 else [])])


def _namespace_exists(release: Release) -> bool:
    """Return False if the namespace certainly does not exist; many users may not ask for it."""
    try:
        release.request("get", "namespaces", name=release.namespace)
    except NotFoundError:
        return False
    except ClusterError:
        pass
    return True
