# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link verify`: compare a link with its profile, by probes or in flight."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cloudrc.base.errors import BadInputError
from cloudrc.doors.cli.output import output_argument, paint, print_result
from cloudrc.doors.cli.parser import Options, Parser, number
from cloudrc.doors.cli.where import flown_release, release_arguments
from cloudrc.link.verify import DEFAULT

if TYPE_CHECKING:
    from cloudrc.flight.links.verify import Report

EPILOG = """\
examples:
  cloudrc link verify                       the link of the paper's experiment
  cloudrc link verify satellite
  cloudrc link verify paper --set link.uplink.loss=0.05 -o json

The command starts the link's processes on this machine, one per direction, and
sends numbered probes through each. The random numbers of a relay are known, so
the command can predict the delay of each probe; it compares netem with 200
simulated links. Tolerances: max(2 ms, 5 %) of the mean delay, 10 % of the
jitter, max(2 percentage points, 25 %) of the loss. It measures a second time
before it reports that something is off.

With --mode cluster the command judges the link of a release in flight by the
tunnel's own datagrams, within a minute. It reports what it cannot judge.

exit codes: 0 verified, 1 not verified or undecided, 2 bad input,
3 missing prerequisite, 4 no answer in time, 5 cluster, 6 a process died"""


def arguments(parser: Parser) -> None:
    """Declare the arguments."""
    about = f"name of a shipped one, or a file (default: {DEFAULT})"
    parser.add_argument(
        "target", nargs="?", default=DEFAULT, metavar="PROFILE|EXPERIMENT", help=about
    )
    about = "override one value of the experiment, for example link.uplink.loss=0.1"
    parser.add_argument(
        "--set", dest="settings", action="append", default=[], metavar="KEY=VALUE", help=about
    )
    about = (
        "time to send probes (default: as long as needed, at most 120); with --mode cluster: "
        "time to wait for a verdict (default: 270)"
    )
    parser.add_argument("--seconds", type=number(1, 3600, "seconds"), metavar="S", help=about)
    about = "relay (default), or netem between two network namespaces (needs root)"
    parser.add_argument("--shaper", choices=("relay", "netem"), default="relay", help=about)
    about = "a link started on this machine (default), or the link of a release"
    parser.add_argument("--mode", choices=("local", "cluster"), default="local", help=about)
    about = "hosts of a release's two pods, from inside its cluster; used by 'helm test'"
    parser.add_argument("--ends", metavar="WORLD,CLOUD", help=about)
    release_arguments(parser)
    output_argument(parser)


def execute(options: Options) -> int:
    """Measure the link and print the verdict; return 0 if the link matches its profile, else 1."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.flight.links.verify import as_text  # imports large packages

    with Progress("measures the link"):
        report = _verify(options)
    print_result(options.output, report, as_text(report, paint))
    return 0 if report["verdict"] == "believed" else 1


def _verify(options: Options) -> Report:
    if options.ends or options.mode == "cluster":
        return _verify_release(options)
    from cloudrc.flight.links.verify import verify

    return verify(
        options.target,
        options.settings,
        shaper=options.shaper,
        seconds=options.seconds,
    )


def _verify_release(options: Options) -> Report:
    from cloudrc.cluster.verify import RELEASE_TIMEOUT, forwarded_pods, pods_at, verify_release

    limit = options.seconds or RELEASE_TIMEOUT
    if not options.ends:
        release = flown_release(options)
        with forwarded_pods(release) as pods:
            return verify_release(release.name, pods, limit)
    hosts = options.ends.split(",")
    if len(hosts) != 2 or not all(hosts):
        raise BadInputError(f"--ends {options.ends}: give two hosts, WORLD,CLOUD")
    return verify_release(options.release or "cloudrc", pods_at(hosts), limit)
