# SPDX-License-Identifier: Apache-2.0

"""Flags that say which flight is meant: a run on this machine, an API, a release in a cluster.

The token of teleop's API is read from a file, because a token on the command line would appear in
the list of processes and in the history of the shell.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.errors import BadInputError, MissingPrerequisiteError
from cloudrc.base.files import warn_if_readable
from cloudrc.base.outside.paths import TOKEN_VARIABLE, read_token
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.requirements import require
from cloudrc.cluster import DEFAULT_RELEASE as DEFAULT_RELEASE
from cloudrc.doors.cli.output import tell
from cloudrc.doors.cli.parser import (
    KUBECTL_PLUGIN,
    Arguments,
    Options,
    Parser,
    number,
    whole_number,
)

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release
    from cloudrc.doors.cli.under_way import RunInFlight

READY_LIMIT = 300.0
"""Default time limit for the pods of a release to become ready [s]."""


def release_arguments(parser: Parser, default: str = "the only one of the namespace") -> Arguments:
    """Declare `--context` and `--namespace`, as in kubectl, and `--release` with a default.

    Return the group of the help, for other flags.
    """
    group = cluster_arguments(parser, "(default: the context's, or default)")
    group.add_argument("--release", metavar="NAME", help=f"Helm release (default: {default})")
    about = "number of a robot, if the release is a fleet"
    group.add_argument("--robot", type=whole_number(0, 999), metavar="K", help=about)
    return group


def cluster_arguments(parser: Parser, namespace: str) -> Arguments:
    """Declare `--context` and `--namespace`; the help of the latter ends with `namespace`.

    Return the group of the help, for other flags.
    """
    group: Arguments = parser.add_argument_group("in a cluster (uses KUBECONFIG)")
    group.add_argument("--context", metavar="NAME", help="kubeconfig context (default: current)")
    group.add_argument("-n", "--namespace", metavar="NAME", help=f"namespace {namespace}")
    return group


def timeout_argument(parser: Parser) -> None:
    """Declare `--timeout`, the time limit for a release to become ready."""
    about = f"seconds to wait until the release is ready (default: {READY_LIMIT:g})"
    seconds = number(1e-3, 86_400, "seconds")
    parser.add_argument("--timeout", type=seconds, default=READY_LIMIT, metavar="S", help=about)


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

    found = choose_release(options.context, options.namespace, options.release)
    return replace(found, robot=options.robot)


def run_argument(parser: Parser) -> None:
    """Declare the flag `--run`, which names a run on this machine."""
    parser.add_argument(
        "--run", type=Path, metavar="DIR", help="folder of a run that is flying on this machine"
    )


def find_local_run(
    options: Options, *, steers: bool = True, links: bool = False
) -> RunInFlight | None:
    """Find the run in flight that a command means; None if its flags name a cluster.

    The parameters and errors are those of `cli.under_way.find_run`.
    """
    in_cluster = options.context or options.namespace or options.release
    if options.run is None and (in_cluster or Path(sys.argv[0]).name == KUBECTL_PLUGIN):
        return None
    if in_cluster:
        raise BadInputError("--run names a run here, the other flags a cluster; give one")
    from cloudrc.doors.cli.under_way import find_run

    return find_run(options.run, steers=steers, links=links)


def need_run_here(run: Path | None, *, steers: bool = True, elsewhere: bool = True) -> RunInFlight:
    """Find a run as `cli.under_way.find_run` does; raise a BadInputError if none flies."""
    from cloudrc.doors.cli.under_way import find_run

    if (found := find_run(run, steers=steers, elsewhere=elsewhere)) is None:
        raise BadInputError("no run flies here; start one: cloudrc up")
    return found


def need_release(options: Options) -> Release:
    """Return the release in flight, for a command that has found no run on this machine."""
    try:
        return flown_release(options)
    except MissingPrerequisiteError as error:
        if options.context or options.namespace:
            raise
        text = "no run flies here; start one: cloudrc up"
        raise MissingPrerequisiteError(f"{text}; and {error}") from None


def api_arguments(parser: Arguments, text: str, *, required: bool = False) -> None:
    """Declare --api, the address of teleop's API, and --token-file."""
    parser.add_argument("--api", type=_api, required=required, metavar="URL", help=text)
    about = f"file with the API's token (default: from {TOKEN_VARIABLE}, or the release's Secret)"
    parser.add_argument("--token-file", type=Path, metavar="FILE", help=about)


def _api(text: str) -> str:
    from cloudrc.teleop.client import Api

    try:
        return Api(text).url
    except InvalidValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def given_token(options: Options) -> Callable[[], str] | None:
    """Return a function that reads the token from the file that the user has named, else None.

    The flag comes before the environment. Print a warning if other users can read the file.
    """
    if path := options.token_file:
        named = f"--token-file {path}"
    elif name := os.environ.get(TOKEN_VARIABLE):
        path, named = Path(name), f"{TOKEN_VARIABLE}={name}"
    else:
        return None
    warn_if_readable(path, tell)
    return lambda: read_token(path, named)
