"""Run `cloudrc link verify`: measure a link with probes and compare it with its profile."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.cluster_flags import release_arguments, release_from_flags
from cloudrc.cli.output import escape, format_document, output_argument
from cloudrc.cli.pool import interrupt_on_signals
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.cli.link_verify_text import VerifyReport
    from cloudrc.config.load import ResolvedExperiment

EPILOG = """\
examples:
  cloudrc link verify                       the link of the paper's experiment
  cloudrc link verify satellite
  cloudrc link verify paper --set link.uplink.loss=0.05 -o json

The command starts the link's processes on this machine, one per direction, and
sends numbered probes of the tunnel's size through each. It sends enough probes
to decide: it believes a wrong link in 1 of 1000 cases and refuses a correct one
in 1 of 100,000. Wrong means off by max(2 ms, 5 %) in the mean delay, 10 % in
the jitter, or max(2 percentage points, 25 %) in the loss.

With --mode cluster the command judges the link of a release in flight by the
tunnel's own datagrams. This takes 15 to 30 s with a relay, whose random draws
are known, and 20 s to 4 min with netem. It reports what it cannot judge.

exit codes: 0 believed, 1 not believed or undecided, 2 bad input,
3 missing prerequisite, 4 no answer in time, 5 cluster, 6 a process died"""
DEFAULT = "paper"
SHAPERS = ("relay", "netem")
RELEASE_TIMEOUT = 270.0
"""Default time limit for the verdict on a release [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the action's arguments."""
    parser.add_argument(
        "target",
        nargs="?",
        default=DEFAULT,
        metavar="PROFILE|EXPERIMENT",
        help=f"name of a shipped one, or a file (default: {DEFAULT})",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        dest="settings",
        help="override one value of the experiment, for example link.uplink.loss=0.1",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help="time to send probes (default: as long as needed, at most 600); with --mode cluster: "
        "time to wait for a verdict (default: 270)",
    )
    parser.add_argument(
        "--shaper",
        choices=SHAPERS,
        default="relay",
        help="relay (default), or netem between two network namespaces (needs root)",
    )
    parser.add_argument(
        "--mode",
        choices=("local", "cluster"),
        default="local",
        help="a link started on this machine (default), or the link of a release",
    )
    parser.add_argument(
        "--ends",
        metavar="WORLD,CLOUD",
        help="hosts of a release's two pods, from inside its cluster; used by 'helm test'",
    )
    release_arguments(parser)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Measure the link, print the verdict; return 0 if the link is believed."""
    if options.seconds is not None and not 1.0 <= options.seconds <= 3600.0:
        raise BadInputError(f"--seconds {options.seconds:g}: give a number from 1 to 3600")
    from cloudrc.cli.link_verify_text import as_document, as_text

    interrupt_on_signals()  # on a signal, remove namespaces and processes
    if options.ends or options.mode == "cluster":
        report = _verify_release(options)
    else:
        from cloudrc.cli.link_verify_run import verify

        experiment = find_experiment(options.target, options.settings)
        report = verify(experiment, options.target, options.shaper, options.seconds, _progress)
    if options.output == "table":
        print(as_text(report))
    else:
        print(format_document(as_document(report), options.output))
    return 0 if report.verdict == "believed" else 1


def _verify_release(options: argparse.Namespace) -> VerifyReport:
    """Query the ends of a release, at given hosts or through the cluster's API."""
    from cloudrc.cli.link_verify_ends import END_PORT, LINK_PORT, Pod, verify_ends

    limit = options.seconds or RELEASE_TIMEOUT
    if options.ends:
        hosts = options.ends.split(",")
        if len(hosts) != 2 or not all(hosts):
            raise BadInputError(f"--ends {options.ends}: give two hosts, WORLD,CLOUD")
        pods = {
            end: Pod(f"http://{host}:{END_PORT}", f"http://{host}:{LINK_PORT}")
            for end, host in zip(("world", "cloud"), hosts, strict=True)
        }
        return verify_ends(pods, options.release or "cloudrc", limit, _progress)
    from contextlib import ExitStack

    release = release_from_flags(options)
    from cloudrc.cluster.pods import find_pod, forwarded

    with ExitStack() as stack:
        pods = {}
        for end in ("world", "cloud"):
            pod = find_pod(release, end).metadata.name
            ports = stack.enter_context(forwarded(release, pod, [END_PORT, LINK_PORT]))
            urls = [f"http://127.0.0.1:{ports[port]}" for port in (END_PORT, LINK_PORT)]
            pods[end] = Pod(*urls)
        return verify_ends(pods, release.name, limit, _progress)


def find_experiment(target: str, settings: list[str]) -> ResolvedExperiment:
    """Find the experiment; a profile replaces the link of the default experiment."""
    from cloudrc.config import shipped
    from cloudrc.config.load import read_experiment
    from cloudrc.config.schema import Experiment, Profile

    if target in shipped.names("experiment"):
        return read_experiment(target, settings)
    is_profile = target in shipped.names("profile")
    if shipped.is_path(target):
        tree = shipped.read("profile", target, _here()).tree
        is_profile = set(tree).isdisjoint(set(Experiment.model_fields) - set(Profile.model_fields))
    elif not is_profile:
        names = ", ".join([*shipped.names("profile"), *shipped.names("experiment")])
        raise BadInputError(f"no profile or experiment named '{target}'; available: {names}")
    if is_profile:
        name = str(_here() / target) if shipped.is_path(target) else target
        return read_experiment(DEFAULT, [f"link.profile={name}", *settings])
    return read_experiment(target, settings)


def _here() -> Path:
    return Path.cwd()


def _progress(line: str) -> None:
    """Show progress in one line, on a terminal only."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{escape(line)}", end="", file=sys.stderr, flush=True)
