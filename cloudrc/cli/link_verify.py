"""Run `cloudrc link verify`: compare a link with its profile, with probes or in flight."""

from __future__ import annotations

import argparse
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.cluster_flags import release_arguments, release_from_flags
from cloudrc.cli.output import escape, format_document, output_argument
from cloudrc.cli.pool import interrupt_on_signals
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.cli.link_verify_report import Report
    from cloudrc.config.load import ResolvedExperiment

EPILOG = """\
examples:
  cloudrc link verify                       the link of the paper's experiment
  cloudrc link verify satellite
  cloudrc link verify paper --set link.uplink.loss=0.05 -o json

The command starts the link's processes on this machine, one per direction, and
sends numbered probes through each. A relay's draws are known, so each probe has
a predicted delay; netem is compared with 200 simulated links. Tolerances:
max(2 ms, 5 %) of the mean delay, 10 % of the jitter, max(2 percentage points,
25 %) of the loss. What is off is measured again before it is reported.

With --mode cluster the command judges the link of a release in flight by the
tunnel's own datagrams, within a minute. It reports what it cannot judge.

exit codes: 0 believed, 1 not believed or undecided, 2 bad input,
3 missing prerequisite, 4 no answer in time, 5 cluster, 6 a process died"""
DEFAULT = "paper"
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
        help="time to send probes (default: as long as needed, at most 120); with --mode cluster: "
        "time to wait for a verdict (default: 270)",
    )
    parser.add_argument(
        "--shaper",
        choices=("relay", "netem"),
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
    interrupt_on_signals()  # on a signal, remove namespaces and processes
    if options.ends or options.mode == "cluster":
        report = _verify_release(options)
    else:
        from cloudrc.cli.link_verify_local import verify

        experiment = find_experiment(options.target, options.settings)
        report = verify(options.target, experiment, options.shaper, options.seconds, _tell)
    from cloudrc.cli.link_verify_report import as_text

    table = options.output == "table"
    print(as_text(report) if table else format_document(report, options.output))
    return 0 if report["verdict"] == "believed" else 1


def _verify_release(options: argparse.Namespace) -> Report:
    """Query the ends of a release, at given hosts or through the cluster's API."""
    from cloudrc.cli.link_verify_report import END_PORT, LINK_PORT, verify

    name, ports = options.release or "cloudrc", (END_PORT, LINK_PORT)
    with ExitStack() as stack:
        if options.ends:
            hosts = options.ends.split(",")
            if len(hosts) != 2 or not all(hosts):
                raise BadInputError(f"--ends {options.ends}: give two hosts, WORLD,CLOUD")
            urls = [[f"http://{host}:{port}" for port in ports] for host in hosts]
        else:
            from cloudrc.cluster.pods import find_pod, forwarded

            release, urls = release_from_flags(options), []
            name = release.name
            for end in ("world", "cloud"):
                pod = find_pod(release, end).metadata.name
                local = stack.enter_context(forwarded(release, pod, ports))
                urls.append([f"http://127.0.0.1:{local[port]}" for port in ports])
        pods = dict(zip(("world", "cloud"), urls, strict=True))
        return verify(name, pods, options.seconds or RELEASE_TIMEOUT, _tell)


def find_experiment(target: str, settings: list[str]) -> ResolvedExperiment:
    """Find the experiment; a profile replaces the link of the default experiment."""
    from cloudrc.config import shipped
    from cloudrc.config.load import read_experiment
    from cloudrc.config.schema import Experiment, Profile

    names = [*shipped.names("profile"), *shipped.names("experiment")]
    is_profile = target not in shipped.names("experiment")
    if shipped.is_path(target):
        tree = shipped.read("profile", target, Path.cwd()).tree
        is_profile = set(tree).isdisjoint(set(Experiment.model_fields) - set(Profile.model_fields))
    elif target not in names:
        raise BadInputError(
            f"no profile or experiment named '{target}'; available: {', '.join(names)}"
        )
    if not is_profile:
        return read_experiment(target, settings)
    name = str(Path.cwd() / target) if shipped.is_path(target) else target
    return read_experiment(DEFAULT, [f"link.profile={name}", *settings])


def _tell(line: str) -> None:
    """Show progress in one line, on a terminal only."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{escape(line)}", end="", file=sys.stderr, flush=True)
