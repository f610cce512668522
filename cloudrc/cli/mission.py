"""Run `cloudrc mission`: fly and steer missions by requests to the API of teleop.

In a cluster, `run` creates a Kubernetes Job, whose pod posts the mission to the API.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import TYPE_CHECKING, NoReturn

from cloudrc.cli.cluster_flags import flown_release, release_arguments, timeout_argument
from cloudrc.cli.find_run import find_local_run, no_run_error, run_argument
from cloudrc.cli.output import leave_message, output_argument, print_line, print_result
from cloudrc.cli.parser import add_verbs, number
from cloudrc.cli.token_flag import given_token, token_argument
from cloudrc.errors import BadInputError, CloudrcError, MissingPrerequisiteError
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.missions import MissionFollower, read_mission
from cloudrc.teleop.client import (
    Api,
    UnreachableError,
    describe_mission,
    describe_verdict,
    mission_path,
)
from cloudrc.teleop.telling import (
    describe_event,
    describe_history,
    describe_robot,
    describe_stay,
    missions_table,
)

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release

EPILOG = """\
where:
  a run on this machine ('cloudrc up', 'cloudrc run'): found automatically, or
  named by --run DIR or --api URL
  a release in a cluster: if --context, -n or --release is given, or if there is
  no run on this machine; always with 'kubectl cloudrc mission'
  If several runs fly, or ./runs/latest has ended, name the flight by a flag.

examples:
  cloudrc mission run pipes
  cloudrc mission hold
  cloudrc mission goto 0.5 0 1.2
  cloudrc mission drive
  cloudrc mission estop
  cloudrc mission run my.yaml --queue --context kind-cloudrc -n demo
  cloudrc mission logs --follow

A mission is a file with 'waypoints'; 'cloudrc list missions' names those that
ship. The exit code of 'run' and 'fly' is the verdict: 0 done, 1 failed, 6 not
real time. 'estop' switches the robot off at once, with or without a mission; a
robot in the air falls. After an emergency stop or a landing, 'acknowledge'
allows the next mission. An API in a network asks for a token: give --token-file
or CLOUDRC_TOKEN_FILE; for a release the command reads its Secret with your
rights in the cluster. A run that is found on this machine needs no token."""
READS = ("list", "status", "logs")
"""Verbs that do not steer the robot."""
RUN_TIMEOUT, API_TIMEOUT = 10.0, 180.0
"""Time limits for an API that does not answer [s]: for a user's command, and for the pod of a Job.
The second limit is longer, because the pod of the API may still have to load its image."""
LEASE = 60.0
"""Default lease of a mission that `mission fly` posts [s]."""
TERMINATED = 143
"""Exit code of `mission fly` after SIGTERM. Kubernetes then starts a new pod, because the Job
ignores this code."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    verbs = add_verbs(parser, {name: line for name, (line, _) in VERBS.items()})
    for name, verb in verbs.items():
        url = "http://HOST:PORT[/PATH] or unix:PATH of a run or release"
        verb.add_argument("--api", metavar="URL", help=url)
        token_argument(verb)
        if name != "fly":
            run_argument(verb)
            release_arguments(verb)
    run, fly = verbs["run"], verbs["fly"]
    run.add_argument("mission", metavar="FILE", help="mission file, or name of a shipped mission")
    timeout_argument(run)
    run.add_argument("--name", default="", help="name shown to people (default: the file's name)")
    fly.add_argument("--mission", required=True, metavar="FILE", help="mission file")
    fly.add_argument("--key", default="", help="a mission posted twice under one key flies once")
    lease = f"seconds that the mission flies on after the end of this command (default: {LEASE:g})"
    seconds = number(5, 3600, "seconds")
    fly.add_argument("--lease", type=seconds, default=LEASE, metavar="S", help=lease)
    queue = "wait for the current mission to end"
    for verb in (run, fly):
        verb.add_argument("--queue", action="store_true", help=queue)
    output_argument(verbs["list"])
    output_argument(verbs["status"])
    for name, default in (
        ("status", "show the robot"),
        ("cancel", "the current one"),
        ("logs", "all"),
    ):
        verbs[name].add_argument(
            "id", nargs="?", metavar="ID", help=f"mission (default: {default})"
        )
    follow = "keep printing new events"
    verbs["logs"].add_argument("-f", "--follow", action="store_true", help=follow)
    about, metres = "[m], world frame", number(-1000, 1000, "metres")
    for axis in "XY":
        verbs["goto"].add_argument(axis.lower(), type=metres, metavar=axis, help=about)
    about += "; none for a robot on the ground"
    verbs["goto"].add_argument("z", nargs="?", type=metres, metavar="Z", help=about)
    about = "heading there [deg], for a robot that obeys a yaw"
    degrees = number(-360, 360, "degrees")
    verbs["goto"].add_argument("--yaw", type=degrees, metavar="DEG", help=about)


def execute(options: argparse.Namespace) -> int:
    """Run the chosen action."""
    verb: str = options.verb
    _, carry_out = VERBS[verb]
    if options.api:
        return carry_out(options, Api(options.api, given_token(options) or str))
    if verb == "fly":
        raise BadInputError("fly needs --api; without a Job use: cloudrc mission run FILE")

    if (found := find_local_run(options, steers=verb not in READS)) is not None:
        api = Api(found.url, place=str(found.folder))  # it needs no token: send none
        return carry_out(options, api)
    if verb == "run":
        return _run_job(options)
    with _forwarded_api(options) as forwarded:
        return carry_out(options, forwarded)


def _run(options: argparse.Namespace, api: Api) -> int:
    """Post a mission, follow it to its verdict, and return the exit code of the verdict.

    After Ctrl-C the mission goes on.
    """
    interrupt_on_signals()
    follower = MissionFollower(api, RUN_TIMEOUT, tell=print_line)
    order = read_mission(options.mission, options.name)
    mission_id = follower.post({**order, "queue": options.queue})
    try:
        verdict = follower.follow(mission_id)
    except KeyboardInterrupt:
        command = f"cloudrc mission cancel {mission_id}"
        print_line(f"mission {mission_id} goes on; cancel it: {command}", sys.stderr)
        raise
    print_line(describe_verdict(verdict))
    return int(verdict["exit_code"])


def _fly(options: argparse.Namespace, api: Api) -> int:
    """Like `_run`, in the pod of a Job: a watcher of the mission, whose end does not end it.

    SIGTERM, by which Kubernetes ends a pod, leaves the mission to the next pod with the same key.
    Teleop cancels the mission if no pod follows it for the time of the lease. Ctrl-C of somebody
    who runs this command by hand cancels the mission at once.
    """
    signal.signal(signal.SIGTERM, _leave)
    follower = MissionFollower(api, API_TIMEOUT, options.lease, print_line)
    order = {**read_mission(options.mission), "key": options.key}
    mission_id = follower.post({**order, "queue": options.queue})
    try:
        verdict = follower.follow(mission_id)
    except KeyboardInterrupt:
        with suppress(CloudrcError):
            api.post(f"{mission_path(mission_id)}/cancel")
        print_line("INTERRUPTED: the mission is cancelled")
        raise
    text = describe_verdict(verdict)
    print_line(text)
    leave_message(text)
    return int(verdict["exit_code"])


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    """End this process at once; an exception could get lost where libraries catch it."""
    text = "this watcher of the mission is stopped; the mission goes on if a new one follows it"
    os.write(sys.stdout.fileno(), f"{text}\n".encode())  # `print` may be interrupted itself
    leave_message(text)
    os._exit(TERMINATED)


def _say(api: Api, text: str) -> None:
    """Print a text after the name of the run or release; without a name, only the text."""
    print_line(f"{api.place}: {text}" if api.place else text)


def _list(options: argparse.Namespace, api: Api) -> int:
    missions = api.get("/v1/missions")["missions"]
    if options.output != "table":
        print_result(options.output, {"missions": missions}, "")
        return 0
    if api.place or not missions:
        _say(api, "missions, the oldest first" if missions else "no missions yet")
    if missions:
        print(missions_table(missions))
    return 0


def _status(options: argparse.Namespace, api: Api) -> int:
    state = api.get(mission_path(options.id) if options.id else "/v1/state")
    if options.output != "table":
        print_result(options.output, state, "")
        return 0
    mission = state if options.id else state["mission"]
    _say(api, describe_mission(mission) if mission else "no mission is under way")
    if options.id:
        _print_lines(describe_history(state))
        return 0
    if state["queue"]:
        print_line(f"waiting: {', '.join(state['queue'])}")
    _print_lines(describe_robot(state["seen"], state["cloud_age_s"]))
    return 0


def _cancel(options: argparse.Namespace, api: Api) -> int:
    mission = {"id": options.id} if options.id else api.get("/v1/state")["mission"]
    if mission is None:
        raise BadInputError("no mission is under way; 'cloudrc mission list' shows all")
    cancelled = api.post(f"{mission_path(mission['id'])}/cancel")
    _say(api, f"{_stay(api)}; {describe_mission(cancelled)}")
    return 0


def _logs(options: argparse.Namespace, api: Api) -> int:
    if options.follow:
        for event in api.events():
            if not options.id or event["mission"] == options.id:
                print_line(describe_event(event))
    elif options.id:
        _print_lines(describe_history(api.get(mission_path(options.id))))
    else:
        ids = [mission["id"] for mission in api.get("/v1/missions")["missions"]]
        events = [event for each in ids for event in api.get(mission_path(each))["events"]]
        _print_lines(map(describe_event, sorted(events, key=lambda event: int(event["id"]))))
    return 0


def _order(options: argparse.Namespace, api: Api) -> int:
    if options.verb == "goto":
        point = [each for each in (options.x, options.y, options.z) if each is not None]
        action = f"on the way to ({', '.join(f'{each:g}' for each in point)})"
        order: dict[str, object] = {"position_m": point}
        if options.yaw is not None:
            order["yaw_deg"] = options.yaw
            action += f", yaw {options.yaw:g} deg"
        mission = api.post("/v1/goto", order)
    else:
        mission = api.post(f"/v1/{options.verb}")
        if options.verb == "resume" and mission["by_hand"]:
            _say(api, f"the drive ends, and the robot holds; mission {mission['id']} is then done")
            return 0
        action = "following the setpoints of a file"
        if mission["waypoints"]:
            action = f"flying to waypoint {mission['waypoint'] + 1} of {mission['waypoints']}"
        action = _stay(api) if options.verb == "hold" else action
    _say(api, f"{action}; {describe_mission(mission)}")
    return 0


def _stay(api: Api) -> str:
    return describe_stay(api.get("/v1/state"))


def _estop(options: argparse.Namespace, api: Api) -> int:
    mission = api.post("/v1/estop")["id"]
    _say(api, "emergency stop: sent, and repeated until the robot is switched off")
    if mission:
        print_line(f"mission {mission} has failed")
    return 0


def _acknowledge(options: argparse.Namespace, api: Api) -> int:
    api.post("/v1/acknowledge")
    _say(api, "acknowledged: the next mission may fly; a landing close to the ground ends first")
    print(
        "after a stop or a landing the robot starts only once it is at rest inside the fence; one "
        "that flies needs 0.5 m of room to its walls"
    )
    return 0


def _drive(_: argparse.Namespace, api: Api) -> int:
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise BadInputError("mission drive needs a terminal; from a program use POST /v1/drive")
    import curses

    from cloudrc.console.terminal import drive

    try:
        drive(api)
    except curses.error as error:
        raise BadInputError(f"mission drive: {error}; set TERM, for example to xterm") from None
    print_line("the drive has ended; to see what the robot does next: cloudrc mission status")
    return 0


VERBS: dict[str, tuple[str, Callable[[argparse.Namespace, Api], int]]] = {
    "run": ("fly a mission and show its progress until the verdict", _run),
    "list": ("list all missions", _list),
    "status": ("show the robot's state, or the state of a mission", _status),
    "cancel": ("cancel a mission; the robot holds its position", _cancel),
    "logs": ("show the events of missions", _logs),
    "goto": ("go to a point; a held mission then holds there", _order),
    "drive": ("drive the robot with the keys of this terminal", _drive),
    "hold": ("hold the robot where it is, at least 0.35 m above the ground", _order),
    "resume": ("resume the held mission", _order),
    "estop": ("switch off at once: a flying robot falls, and its mission fails", _estop),
    "acknowledge": (
        "allow flights again after a stop or a landing; does not start the robot",
        _acknowledge,
    ),
    "fly": ("fly a mission inside a Job: post it, follow it, exit with the verdict", _fly),
}
"""Verb -> help line, and function that carries it out."""


def _print_lines(lines: Iterable[str]) -> None:
    for line in lines:
        print_line(line)


def _release(options: argparse.Namespace) -> Release:
    try:
        return flown_release(options)
    except MissingPrerequisiteError as error:
        raise no_run_error(options, error, "--run, --api") from None


@contextmanager
def _forwarded_api(options: argparse.Namespace) -> Iterator[Api]:
    """Yield the API of a release, which is reachable over a forwarded port while the block runs.

    If the API does not answer, and after a status, say which containers of the release end.
    """
    from cloudrc.cluster.client import ClusterError
    from cloudrc.cluster.incidents import troubles
    from cloudrc.cluster.missions import release_api

    release = _release(options)
    try:
        with release_api(release, given_token(options)) as api:
            named = options.context or options.namespace or options.release
            if options.verb in READS and not named:
                print_line(f"cloudrc: using {api.place}", sys.stderr)
            yield api
    except UnreachableError as error:
        if found := troubles(release):
            raise ClusterError("; ".join(found)) from error
        raise
    if options.verb == "status":
        file = sys.stdout if options.output == "table" else sys.stderr
        for line in troubles(release):
            print_line(line, file)


def _run_job(options: argparse.Namespace) -> int:
    """Create the Job of a mission, follow its log, and return the exit code of its verdict."""
    interrupt_on_signals()
    mission, release = read_mission(options.mission, options.name), _release(options)
    from cloudrc.cluster.flight import begin_job, cancelling_command, follow_job

    job = begin_job(release, mission, print_line, options.timeout, queue=options.queue)
    try:
        return follow_job(release, job, print_line).exit_code
    except KeyboardInterrupt:
        remedy = cancelling_command(release, job)
        print_line(f"Job {job} is still running; cancel its mission: {remedy}", sys.stderr)
        raise
