"""`cloudrc mission`: missions and the operator's hand, on a run here or a release in a cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.cli.client import reader, token_argument, token_file
from cloudrc.cli.cluster_flags import place_arguments, timeout_argument
from cloudrc.cli.find_run import find_here, run_argument, url_of
from cloudrc.cli.output import output_argument

if TYPE_CHECKING:
    from cloudrc.cli.client import Api

EPILOG = """\
where:
  a run that flies here ('cloudrc run --mode local'): found by itself, that of
  ./runs/latest first, or by --run, its folder, or by --api
  a release in a cluster: with --context, -n or --release, if none flies here,
  and always as 'kubectl cloudrc mission'

examples:
  cloudrc mission run pipes
  cloudrc mission hold
  cloudrc mission goto 0.5 0 1.2
  cloudrc mission estop
  cloudrc mission run my.yaml --queue --context kind-cloudrc -n demo
  cloudrc mission logs --follow

A mission is a file with 'waypoints', such as those that 'cloudrc list missions'
names. 'run' and 'fly' end with its verdict: 0 done, 1 failed, 6 not real time.
'estop' stops the rotors at once, whatever flies, and lets the robot fall; that
and a landing, whatever its cause, are left by 'acknowledge'. An API that is
called over a network asks for a token: --token-file, CLOUDRC_TOKEN_FILE, or for
a release of the chart its Secret, read with your own rights in the cluster. A
run that is found here is sent none."""

NO_API = "no run with an API flies there; name another folder, or --api URL"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB")

    def add(name: str, line: str) -> argparse.ArgumentParser:
        verb = verbs.add_parser(
            name,
            help=line,
            description=line[0].upper() + line[1:] + ".",
            formatter_class=parser.formatter_class,
            allow_abbrev=False,
        )
        verb.add_argument("--debug", action="store_true", default=argparse.SUPPRESS)
        verb.add_argument(
            "--api", metavar="URL", help="http://HOST:PORT or unix:PATH of a run or release"
        )
        token_argument(verb)
        if name != "fly":
            run_argument(verb)
            place_arguments(verb)
        return verb

    run = add("run", "fly a mission and follow it to its verdict")
    run.add_argument("mission", metavar="FILE", help="a mission's file, or one that ships")
    timeout_argument(run)
    run.add_argument("--name", default="", help="for people (default: the file's name)")
    for name in ("list", "status"):
        line = {"list": "all missions", "status": "how things are, or how one mission is"}[name]
        shown = add(name, line)
        output_argument(shown)
    shown.add_argument("id", nargs="?", metavar="ID", help="of a mission (in a cluster: of a Job)")
    cancel = add("cancel", "end a mission; the robot holds")
    cancel.add_argument("id", nargs="?", metavar="ID", help="default: the one under way")
    logs = add("logs", "what has happened")
    logs.add_argument("id", nargs="?", metavar="ID", help="default: to all missions")
    logs.add_argument("-f", "--follow", action="store_true", help="and what happens from now on")
    goto = add("goto", "fly to a point, or hold a held mission there")
    for axis in "XYZ":
        goto.add_argument(axis.lower(), type=_metres, metavar=axis, help="[m], world frame")
    add("hold", "stop the robot where it is, 0.35 m up at least")
    add("resume", "go on with the mission that is held")
    add("estop", "stop the rotors at once: the robot falls, and its mission has failed")
    add("acknowledge", "release a robot that was stopped or has landed; arms nothing")
    fly = add("fly", "what a mission's Job runs: post, follow, end with the verdict")
    fly.add_argument("--mission", required=True, metavar="FILE", help="the mission")
    fly.add_argument("--key", default="", help="posting twice under one key flies once")
    for verb in (run, fly):
        verb.add_argument("--queue", action="store_true", help="wait for the one under way")


def execute(options: argparse.Namespace) -> int:
    """Do what the verb says."""
    from cloudrc.cli import mission_cluster, mission_local
    from cloudrc.cli.client import Api

    verb: str = options.verb
    if verb == "fly":
        return mission_local.fly(options)
    of_api: Callable[[argparse.Namespace, Api], int] = mission_local.VERBS[verb]
    if options.api:
        return of_api(options, Api(options.api, reader(token_file(options))))
    if (url := find_here(options, url_of, NO_API)) is not None:
        return of_api(options, Api(url))  # it asks for no token, and so gets none
    if verb in mission_cluster.VERBS:
        in_cluster: Callable[[argparse.Namespace], int] = mission_cluster.VERBS[verb]
        return in_cluster(options)
    with mission_cluster.api(options) as forwarded:
        return of_api(options, forwarded)


def _metres(text: str) -> float:
    """Read a coordinate, as argparse calls it; how far away it may be is the API's to say."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no number of metres") from None
