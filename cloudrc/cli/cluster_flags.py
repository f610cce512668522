"""Flags that name a Helm release of cloudrc in a Kubernetes cluster."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cloudrc.cli.parser import Add, Options, Parser, flags, number
from cloudrc.cluster.client import DEFAULT_RELEASE as DEFAULT_RELEASE
from cloudrc.runs.requirements import require

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release

READY_LIMIT = 300.0
"""Default time limit for the pods of a release to become ready [s]."""


def release_arguments(parser: Parser, default: str = "the only one of the namespace") -> Add:
    """Declare `--context` and `--namespace`, as in kubectl, and `--release` with a default.

    Return a function that adds another flag to the same group of the help.
    """
    add = cluster_arguments(parser, "(default: the context's, or default)")
    add("--release", "NAME", f"Helm release (default: {default})")
    return add


def cluster_arguments(parser: Parser, namespace: str) -> Add:
    """Declare `--context` and `--namespace`; the help of the latter ends with `namespace`.

    Return a function that adds another flag to the same group of the help.
    """
    add = flags(parser.add_argument_group("in a cluster (uses KUBECONFIG)"))
    add("--context", "NAME", "kubeconfig context (default: current)")
    add("-n --namespace", "NAME", f"namespace {namespace}")
    return add


def timeout_argument(parser: Parser) -> None:
    """Declare `--timeout`, the time limit for a release to become ready."""
    about = f"seconds to wait until the release is ready (default: {READY_LIMIT:g})"
    flags(parser)("--timeout", "S", about, READY_LIMIT, number(1e-3, 86_400, "seconds"))


def release_from_flags(options: Options) -> Release:
    """Return the release that the flags name; by default "cloudrc" in the current context.

    Raise a MissingPrerequisiteError if the Kubernetes client or a kubeconfig is missing.
    """
    require("a cluster", ("kube",))
    from cloudrc.cluster.client import connect

    name = getattr(options, "release", None) or DEFAULT_RELEASE
    return connect(options.context, options.namespace, name)


def flown_release(options: Options) -> Release:
    """Return the release that the flags name; without `--release`, the only one of the namespace.

    Raise a BadInputError if the namespace has several, a ClusterError if it has none.
    """
    require("a cluster", ("kube",))
    from cloudrc.cluster.releases import choose_release

    return choose_release(options.context, options.namespace, options.release)
