"""`cloudrc link verify`: a profile comes in; probes go through its link; a verdict goes out."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.cluster_flags import place, place_arguments
from cloudrc.cli.output import harmless, output_argument, written
from cloudrc.cli.pool import end_orderly
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.cli.link_verify_text import Said
    from cloudrc.config.load import ResolvedExperiment

EPILOG = """\
examples:
  cloudrc link verify                       the link of the paper's experiment
  cloudrc link verify satellite
  cloudrc link verify paper --set link.uplink.loss=0.05 -o json

Starts the link's own processes on this machine, one per direction as in pods,
and sends numbered probes of the tunnel's size through each. As many are sent as
it takes: a link that is off by max(2 ms, 5 %) in its mean delay, 10 % in its
jitter or max(2 percentage points, 25 %) in its loss is believed once in a
thousand times, a true one is refused once in a hundred thousand.

With --mode cluster a release that flies is judged by the tunnel's own
datagrams: those of 15 to 30 s where a relay shapes, whose draws are known; of
20 s to 4 min where netem does. What cannot be judged is said.

exit codes: 0 believed, 1 not, or undecided, 2 bad input,
3 missing prerequisite, 4 no answer in time, 5 cluster, 6 a process died"""
DEFAULT = "paper"
SHAPERS = ("relay", "netem")
ENDS_LIMIT = 270.0
"""For the ends of a release to come to a verdict, if the user does not say [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the action's arguments."""
    parser.add_argument(
        "target",
        nargs="?",
        default=DEFAULT,
        metavar="PROFILE|EXPERIMENT",
        help=f"a shipped one's name, or a file (default: {DEFAULT})",
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
        help="how long to probe (default: as long as it takes, at most 600; of a release: how long "
        "to wait for a verdict, default 270)",
    )
    parser.add_argument(
        "--shaper",
        choices=SHAPERS,
        default="relay",
        help="relay (default), or netem between two network namespaces, which needs root",
    )
    parser.add_argument(
        "--mode",
        choices=("local", "cluster"),
        default="local",
        help="a link started here (default), or that of a release in a cluster",
    )
    parser.add_argument(
        "--ends",
        metavar="WORLD,CLOUD",
        help="hosts of a release's two pods, from inside its cluster: what 'helm test' gives",
    )
    place_arguments(parser)
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Probe, judge, tell; exit 0 if the link is believed."""
    if options.seconds is not None and not 1.0 <= options.seconds <= 3600.0:
        raise BadInputError(f"--seconds {options.seconds:g}: give a number from 1 to 3600")
    from cloudrc.cli.link_verify_text import as_document, as_text

    end_orderly()  # without the namespaces and processes that it has made
    if options.ends or options.mode == "cluster":
        said = _ends(options)
    else:
        from cloudrc.cli.link_verify_run import verify

        experiment = find(options.target, options.settings)
        said = verify(experiment, options.target, options.shaper, options.seconds, _progress)
    if options.output == "table":
        print(as_text(said))
    else:
        print(written(as_document(said), options.output))
    return 0 if said.verdict == "believed" else 1


def _ends(options: argparse.Namespace) -> Said:
    """Ask the ends of a release: by their hosts, or through the cluster's API."""
    from cloudrc.cli.link_verify_ends import END_PORT, LINK_PORT, Pod, verify_ends

    limit = options.seconds or ENDS_LIMIT
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

    release = place(options)
    from cloudrc.cluster.pods import find_pod, forwarded

    with ExitStack() as ways:
        pods = {}
        for end in ("world", "cloud"):
            pod = find_pod(release, end).metadata.name
            ports = ways.enter_context(forwarded(release, pod, [END_PORT, LINK_PORT]))
            urls = [f"http://127.0.0.1:{ports[port]}" for port in (END_PORT, LINK_PORT)]
            pods[end] = Pod(*urls)
        return verify_ends(pods, release.name, limit, _progress)


def find(target: str, settings: list[str]) -> ResolvedExperiment:
    """Find the experiment that is meant: a profile's name or file stands for its link alone."""
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
    """Say what is going on, on a terminal only, in place."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{harmless(line)}", end="", file=sys.stderr, flush=True)
