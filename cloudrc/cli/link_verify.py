"""Run `cloudrc link verify`: compare a link with its profile, by probes or in flight."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from contextlib import closing

from cloudrc.cli.cluster_flags import flown_release
from cloudrc.cli.output import paint, print_result
from cloudrc.cli.progress import Progress
from cloudrc.errors import BadInputError
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.verify import (
    RELEASE_TIMEOUT,
    Report,
    as_text,
    check_seconds,
    forwarded_pods,
    pods_at,
    verify,
    verify_release,
)

AWAITED = "waits for the verdicts of both pods"
"""Step of a measurement on a cluster."""


def execute(options: argparse.Namespace) -> int:
    """Measure the link and print the verdict; return 0 if the link matches its profile, else 1."""
    interrupt_on_signals()  # on a signal, remove namespaces and processes
    with closing(Progress("starts")) as view:
        report = _verify(options, view.tell)
    print_result(options.output, report, as_text(report, paint))
    return 0 if report["verdict"] == "believed" else 1


def _verify(options: argparse.Namespace, tell: Callable[[str], None]) -> Report:
    limit = check_seconds(options.seconds) or RELEASE_TIMEOUT
    if options.ends:
        hosts = options.ends.split(",")
        if len(hosts) != 2 or not all(hosts):
            raise BadInputError(f"--ends {options.ends}: give two hosts, WORLD,CLOUD")
        tell(AWAITED)
        return verify_release(options.release or "cloudrc", pods_at(hosts), limit)
    if options.mode == "cluster":
        release = flown_release(options)
        with forwarded_pods(release) as pods:
            tell(AWAITED)
            return verify_release(release.name, pods, limit)
    return verify(
        options.target,
        options.settings,
        shaper=options.shaper,
        seconds=options.seconds,
        tell=tell,
    )
