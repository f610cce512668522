"""Run `cloudrc mission`: fly and steer missions, in a local run or in a cluster."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import TYPE_CHECKING

from cloudrc.cli.client import token_argument, token_file, token_reader
from cloudrc.cli.cluster_flags import release_arguments, timeout_argument
from cloudrc.cli.find_run import api_url_of, find_local_run, run_argument
from cloudrc.cli.output import output_argument

if TYPE_CHECKING:
    from cloudrc.cli.client import Api

EPILOG = """\
where:
  a run on this machine ('cloudrc run --mode local'): found automatically (first
  ./runs/latest), or named by --run DIR or --api URL
  a release in a cluster: if --context, -n or --release is given, or if no run
  flies on this machine; always with 'kubectl cloudrc mission'

examples:
  cloudrc mission run pipes
  cloudrc mission hold
  cloudrc mission goto 0.5 0 1.2
  cloudrc mission estop
  cloudrc mission run my.yaml --queue --context kind-cloudrc -n demo
  cloudrc mission logs --follow

A mission is a file with 'waypoints'; 'cloudrc list missions' names those that
ship. The exit code of 'run' and 'fly' is the verdict: 0 done, 1 failed, 6 not
real time. 'estop' stops the rotors at once, with or without a mission, and the
robot falls. After an emergency stop or a landing, 'acknowledge' allows the next
mission. An API in a network asks for a token: give --token-file or
CLOUDRC_TOKEN_FILE; for a release the command reads its Secret with your rights
in the cluster. A run that is found on this machine needs no token."""

DEBUG = "show the traceback of an error"
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
        verb.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=DEBUG)
        verb.add_argument(
            "--api", metavar="URL", help="http://HOST:PORT or unix:PATH of a run or release"
        )
        token_argument(verb)
        if name != "fly":
            run_argument(verb)
            release_arguments(verb)
        return verb

    run = add("run", "fly a mission and show its progress until the verdict")
    run.add_argument("mission", metavar="FILE", help="mission file, or name of a shipped mission")
    timeout_argument(run)
    run.add_argument("--name", default="", help="name shown to people (default: the file's name)")
    output_argument(add("list", "list all missions"))
    status = add("status", "show the robot's state, or the state of a mission")
    output_argument(status)
    status.add_argument("id", nargs="?", metavar="ID", help="mission (in a cluster: name of a Job)")
    cancel = add("cancel", "cancel a mission; the robot holds its position")
    cancel.add_argument("id", nargs="?", metavar="ID", help="mission (default: the current one)")
    logs = add("logs", "show the events of missions")
    logs.add_argument("id", nargs="?", metavar="ID", help="mission (default: all)")
    logs.add_argument("-f", "--follow", action="store_true", help="keep printing new events")
    goto = add("goto", "fly to a point; a held mission then holds there")
    for axis in "XYZ":
        goto.add_argument(axis.lower(), type=_metres, metavar=axis, help="[m], world frame")
    add("hold", "hold the robot where it is, at least 0.35 m above the ground")
    add("resume", "resume the held mission")
    add("estop", "stop the rotors at once: the robot falls and its mission fails")
    add("acknowledge", "allow flights again after a stop or a landing; does not start the rotors")
    fly = add("fly", "fly a mission inside a Job: post it, follow it, exit with the verdict")
    fly.add_argument("--mission", required=True, metavar="FILE", help="mission file")
    fly.add_argument("--key", default="", help="a mission posted twice under one key flies once")
    for verb in (run, fly):
        verb.add_argument(
            "--queue", action="store_true", help="wait for the current mission to end"
        )


def execute(options: argparse.Namespace) -> int:
    """Run the chosen verb."""
    from cloudrc.cli import mission_cluster, mission_local
    from cloudrc.cli.client import Api

    verb: str = options.verb
    if verb == "fly":
        return mission_local.fly(options)
    of_api: Callable[[argparse.Namespace, Api], int] = mission_local.VERBS[verb]
    if options.api:
        return of_api(options, Api(options.api, token_reader(token_file(options))))
    if (url := find_local_run(options, api_url_of, NO_API)) is not None:
        return of_api(options, Api(url))  # a local run asks for no token, so send none
    without_job = verb in mission_cluster.OF_ONE_JOB and options.id is None
    if verb in mission_cluster.VERBS and not without_job:
        in_cluster: Callable[[argparse.Namespace], int] = mission_cluster.VERBS[verb]
        return in_cluster(options)
    with mission_cluster.api(options) as forwarded:
        return of_api(options, forwarded)


def _metres(text: str) -> float:
    """Parse a coordinate [m] for argparse; the API checks its range."""
    try:
        return float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number of metres") from None
