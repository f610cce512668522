"""Flags that name a Helm release of cloudrc in a Kubernetes cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.cli.parser import number
from cloudrc.cluster.client import DEFAULT_RELEASE as DEFAULT_RELEASE
from cloudrc.runs.requirements import require

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release

READY_LIMIT = 300.0
"""Default time limit for the pods of a release to become ready [s]."""


def release_arguments(
    parser: argparse.ArgumentParser, default: str = "the only one of the namespace"
) -> Callable[..., argparse.Action]:
    """Declare `--context` and `--namespace`, as in kubectl, and `--release` with a default.

    Return a function that adds another flag to the same group of the help.
    """
    group = cluster_arguments(parser, "(default: the context's, or default)")
    about = f"Helm release (default: {default})"
    group.add_argument("--release", metavar="NAME", help=about)
    return group.add_argument


def cluster_arguments(parser: argparse.ArgumentParser, namespace: str) -> argparse._ArgumentGroup:
    """Declare `--context` and `--namespace`; the help of the latter ends with `namespace`.

    Return the group of the help, to which further flags may be added.
    """
    group = parser.add_argument_group("in a cluster (uses KUBECONFIG)")
    group.add_argument("--context", metavar="NAME", help="kubeconfig context (default: current)")
    group.add_argument("-n", "--namespace", metavar="NAME", help=f"namespace {namespace}")
    return group


def timeout_argument(parser: argparse.ArgumentParser) -> None:
    """Declare `--timeout`, the time limit for a release to become ready."""
    parser.add_argument(
        "--timeout",
        type=number(1e-3, 86_400, "seconds"),
        default=READY_LIMIT,
        metavar="S",
        help=f"seconds to wait until the release is ready (default: {READY_LIMIT:g})",
    )


def release_from_flags(options: argparse.Namespace) -> Release:
    """Return the release that the flags name; by default "cloudrc" in the current context.

    Raise a MissingPrerequisiteError if the Kubernetes client or a kubeconfig is missing.
    """
    require("a cluster", ("kube",))
    from cloudrc.cluster.client import connect

    name = getattr(options, "release", None) or DEFAULT_RELEASE
    return connect(options.context, options.namespace, name)


def flown_release(options: argparse.Namespace) -> Release:
    """Return the release that the flags name; without `--release`, the only one of the namespace.

    Raise a BadInputError if the namespace has several, a ClusterError if it has none.
    """
    require("a cluster", ("kube",))
    from cloudrc.cluster.releases import choose_release

    return choose_release(options.context, options.namespace, options.release)
