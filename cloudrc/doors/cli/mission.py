# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc mission`: fly and steer missions by requests to the API of teleop.

In a cluster, `run` creates a Kubernetes Job, whose pod posts the mission to the API.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from math import inf
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, NoReturn

from cloudrc.base.errors import BadInputError, CloudrcError
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import (
    leave_message,
    output_argument,
    print_line,
    print_lines,
    print_result,
    tell,
)
from cloudrc.doors.cli.parser import (
    Options,
    Parser,
    add_verbs,
    number,
    read_size,
    whole_number,
)
from cloudrc.doors.cli.where import (
    api_arguments,
    find_local_run,
    given_token,
    need_release,
    release_arguments,
    run_argument,
    timeout_argument,
)
from cloudrc.doors.missions import Json, MissionFollower, read_mission
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
  cloudrc mission report my-release m3

A mission is a file with 'waypoints'; 'cloudrc list missions' names those that
ship. The exit code of 'run' and 'fly' is the verdict: 0 done, 1 failed, 6 not
real time. 'estop' switches the robot off at once, with or without a mission; a
robot in the air falls. After an emergency stop or a landing, 'acknowledge'
allows the next mission. An API in a network asks for a token: give --token-file
or CLOUDRC_TOKEN_FILE; for a release the command reads its Secret with your
rights in the cluster. A run that is found on this machine needs no token."""
READS = ("list", "status", "logs", "attach")
"""Verbs that do not steer the robot."""
RUN_TIMEOUT, API_TIMEOUT = 10.0, 180.0
"""Time limits for an API that does not answer [s]: for a user's command, and for the pod of a Job.
The second limit is longer, because the pod of the API may still have to load its image."""
LEASE = 60.0
"""Default lease of a mission that `mission fly` posts [s]."""
TERMINATED = 143
"""Exit code of `mission fly` after SIGTERM. Kubernetes then starts a new pod, because the Job
ignores this code."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    verbs = add_verbs(parser, {name: line for name, (line, _) in VERBS.items()})
    _report_arguments(verbs.pop("report"))
    for name, verb in verbs.items():
        url = "http://HOST:PORT[/PATH] or unix:PATH of a run or release"
        api_arguments(verb, url, required=name == "fly")
        if name != "fly":
            run_argument(verb)
            release_arguments(verb)
    run, fly = verbs["run"], verbs["fly"]
    run.add_argument("mission", metavar="FILE", help="mission file, or name of a shipped mission")
    timeout_argument(run)
    run.add_argument("--name", default="", help="name shown to people (default: the file's name)")
    about = "return once the mission is posted; follow it by 'mission attach'"
    run.add_argument("--detach", action="store_true", help=about)
    fly.add_argument("--mission", required=True, metavar="FILE", help="mission file")
    fly.add_argument("--key", default="", help="a mission posted twice under one key flies once")
    about = f"seconds that the mission flies on after the end of this command (default: {LEASE:g})"
    fly.add_argument(
        "--lease", type=number(5, 3600, "seconds"), default=LEASE, metavar="S", help=about
    )
    about = "Unix time at which to post it: the robots of a fleet begin together"
    fly.add_argument("--at", type=number(0, 1e11, "seconds"), default=0.0, metavar="T", help=about)
    _keep_arguments(fly)
    for verb in (run, fly):
        verb.add_argument(
            "--queue", action="store_true", help="wait for the current mission to end"
        )
    for name in ("list", "status"):
        output_argument(verbs[name])
    ids = {"status": "show the robot", "cancel": "the current one", "logs": "all"}
    for name, default in ids.items():
        verbs[name].add_argument(
            "id", nargs="?", metavar="ID", help=f"mission (default: {default})"
        )
    about = "mission, or Job of 'mission run' (default: the last Job, or the current mission)"
    verbs["attach"].add_argument("id", nargs="?", metavar="ID|JOB", help=about)
    verbs["logs"].add_argument(
        "-f", "--follow", action="store_true", help="keep printing new events"
    )
    goto, about, metres = verbs["goto"], "[m], world frame", number(-1000, 1000, "metres")
    goto.add_argument("x", type=metres, metavar="X", help=about)
    goto.add_argument("y", type=metres, metavar="Y", help=about)
    about += "; none for a robot on the ground"
    goto.add_argument("z", nargs="?", type=metres, metavar="Z", help=about)
    about = "heading there [deg], for a robot that can turn"
    goto.add_argument("--yaw", type=number(-360, 360, "degrees"), metavar="DEG", help=about)


def _report_arguments(parser: Parser) -> None:
    about = "the release (default: the only one of the namespace)"
    parser.add_argument("where", nargs="?", metavar="RELEASE", help=about)
    about = "id of the mission, such as m3, or name of a kept report (default: the last mission)"
    parser.add_argument("mission", nargs="?", default="", metavar="MISSION", help=about)
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder of the report (default: a new one in runs/)"
    )
    output_argument(parser)
    release_arguments(parser)


def _keep_arguments(fly: Parser) -> None:
    """Declare the arguments of a Job that keeps a report in the volume of the recordings."""
    about = "keep a report of the mission beside the recordings in this folder"
    fly.add_argument("--report", type=Path, metavar="DIR", help=about)
    fly.add_argument("--config", type=Path, metavar="FILE", help="experiment file of the release")
    fly.add_argument("--profile", type=Path, metavar="FILE", help="profile of its link")
    about = "largest number of reports (default: 100)"
    fly.add_argument("--keep", type=whole_number(1, 10**6), default=100, metavar="N", help=about)
    about = "largest age of a report in days (default: 30)"
    fly.add_argument(
        "--keep-days", type=number(1e-3, 1e5, "days"), default=30.0, metavar="DAYS", help=about
    )
    about = "largest size of all reports, such as 1Gi"
    fly.add_argument("--keep-size", type=read_size, default=inf, metavar="SIZE", help=about)


def execute(options: Options) -> int | None:
    """Run the chosen action."""
    verb: str = options.verb
    if verb == "report":
        return _report(options)
    _, carry_out = VERBS[verb]
    if options.api:
        return carry_out(options, Api(options.api, given_token(options) or str))
    if (found := find_local_run(options, steers=verb not in READS)) is not None:
        api = Api(found.url, place=str(found.folder))  # it needs no token: send none
        return carry_out(options, api)
    if verb == "run" and options.robot is None:
        return _run_job(options)
    if verb == "attach" and options.robot is None:
        release = need_release(options)
        if job := _find_job(release, options.id):
            return _follow_job(release, job)
    with _forwarded_api(options) as forwarded:
        return carry_out(options, forwarded)


def _run(options: Options, api: Api) -> int:
    """Post a mission, follow it to its verdict, and return the exit code of the verdict.

    After Ctrl-C the mission goes on.
    """

    def stopped(mission: str) -> None:
        tell(f"mission {mission} goes on; cancel it: cloudrc mission cancel {mission}")

    follower = MissionFollower(api, RUN_TIMEOUT, tell=print_line)
    order = read_mission(options.mission, options.name)
    if options.detach:
        mission = follower.post({**order, "queue": options.queue})
        print_line(f"follow it: cloudrc mission attach {mission}")
        return 0
    return _follow(options, follower, order, stopped)


def _attach(options: Options, api: Api) -> int:
    """Follow a mission to its verdict, and return the exit code of the verdict."""
    state = api.get("/v1/state")
    under_way = [state["mission"]["id"]] if state["mission"] else state["queue"]
    if not (options.id or under_way):
        raise BadInputError("no mission is under way; 'cloudrc mission list' shows all")
    follower = MissionFollower(api, RUN_TIMEOUT, tell=print_line)
    verdict = follower.follow(options.id or under_way[0])
    print_line(describe_verdict(verdict))
    return int(verdict["exit_code"])


def _fly(options: Options, api: Api) -> int:
    """Like `_run`, in the pod of a Job: a watcher of the mission, whose end does not end it.

    SIGTERM, by which Kubernetes ends a pod, leaves the mission to the next pod with the same key.
    Teleop cancels the mission if no pod follows it for the time of the lease. Ctrl-C of somebody
    who runs this command by hand cancels the mission at once.
    """

    def stopped(mission: str) -> None:
        with suppress(CloudrcError):
            api.post(f"{mission_path(mission)}/cancel")
        print_line("INTERRUPTED: the mission is cancelled")

    signal.signal(signal.SIGTERM, _leave)
    follower = MissionFollower(api, API_TIMEOUT, options.lease, print_line)
    order = {**read_mission(options.mission), "key": options.key}
    if (left := options.at - time.time()) > 0:
        time.sleep(left)
    elif options.at:
        print_line(f"{-left:.1f} s after the time at which the fleet begins")

    def ended(mission: str) -> None:
        if options.report:
            _keep_report(options, order, api.get(mission_path(mission)))

    return _follow(options, follower, order, stopped, ended)


def _keep_report(options: Options, order: Json, view: Json) -> None:
    """Keep a report of a mission; without one, say why: the verdict counts."""
    from cloudrc.cluster.kept import Retention, keep_report

    if not (options.config and options.profile):
        raise BadInputError("--report needs --config and --profile")
    most = Retention(options.keep, options.keep_days, options.keep_size)
    files = options.config, options.profile
    try:
        folder = keep_report(options.report, files, order, view, most)
        print_line(f"report: {folder.name}")
    except (CloudrcError, OSError) as error:
        print_line(f"no report is kept: {error}")


def _report(options: Options, _: Api | None = None) -> int:
    """Write the report of a mission of a release; return the exit code of its verdict."""
    from cloudrc.cluster.kept import fetch_mission
    from cloudrc.doors.cli import report
    from cloudrc.doors.cli.where import flown_release
    from cloudrc.flight.folder import new_folder

    options.release = options.where or options.release
    release = flown_release(options)
    folder = new_folder(options.out, f"{release.name}-{options.mission or 'last'}")
    try:
        fetch_mission(release, options.mission, folder, tell)
    except CloudrcError:
        with suppress(OSError):
            folder.rmdir()  # nothing was fetched
        raise
    return report.write(options, folder)


def _follow(
    options: Options,
    follower: MissionFollower,
    order: Json,
    stopped: Callable[[str], None],
    ended: Callable[[str], None] = lambda mission: None,
) -> int:
    mission = follower.post({**order, "queue": options.queue})
    try:
        verdict = follower.follow(mission)
    except KeyboardInterrupt:
        stopped(mission)
        raise
    print_line(describe_verdict(verdict))
    ended(mission)
    leave_message(json.dumps(verdict))
    return int(verdict["exit_code"])


def _leave(number: int, frame: FrameType | None) -> NoReturn:
    """End this process at once; an exception could get lost where libraries catch it."""
    text = "this watcher of the mission is stopped; the mission goes on if a new one follows it"
    os.write(sys.stdout.fileno(), f"{text}\n".encode())  # `print` may be interrupted itself
    leave_message(text)
    os._exit(TERMINATED)


def _say(api: Api, text: str) -> None:
    """Print a text after the name of the run or release; without a name, only the text."""
    print_line(_named(api, text))


def _named(api: Api, *lines: str) -> str:
    named = f"{api.place}: {lines[0]}" if api.place else lines[0]
    return "\n".join([named, *lines[1:]])


def _list(options: Options, api: Api) -> None:
    missions = api.get("/v1/missions")["missions"]
    text = _named(api, "no missions yet")
    if missions:
        text = _named(api, "missions, the oldest first", missions_table(missions))
    print_result(options.output, {"missions": missions}, text)


def _status(options: Options, api: Api) -> None:
    state = api.get(mission_path(options.id) if options.id else "/v1/state")
    mission = state if options.id else state["mission"]
    lines = [describe_mission(mission) if mission else "no mission is under way"]
    if options.id:
        lines += describe_history(state)
    else:
        lines += [f"waiting: {', '.join(state['queue'])}"] if state["queue"] else []
        lines += describe_robot(state["seen"], state["cloud_age_s"])
    print_result(options.output, state, _named(api, *map(escape, lines)))


def _cancel(options: Options, api: Api) -> None:
    mission = {"id": options.id} if options.id else api.get("/v1/state")["mission"]
    if mission is None:
        raise BadInputError("no mission is under way; 'cloudrc mission list' shows all")
    cancelled = api.post(f"{mission_path(mission['id'])}/cancel")
    _say_mission(api, cancelled)


def _logs(options: Options, api: Api) -> None:
    if options.follow:
        for event in api.events():
            if not options.id or event["mission"] == options.id:
                print_line(describe_event(event))
        return
    known = api.get("/v1/missions")["missions"]
    ids = [options.id] if options.id else [mission["id"] for mission in known]
    events = [event for each in ids for event in api.get(mission_path(each))["events"]]
    print_lines(map(describe_event, sorted(events, key=lambda event: int(event["id"]))))


def _goto(options: Options, api: Api) -> None:
    point = [each for each in (options.x, options.y, options.z) if each is not None]
    yaw = {} if options.yaw is None else {"yaw_deg": options.yaw}
    mission = api.post("/v1/goto", {"position_m": point, **yaw})
    shown = ", ".join(f"{each:g}" for each in point)
    _say(api, f"on the way to ({shown}); {describe_mission(mission)}")


def _order(options: Options, api: Api) -> None:
    _say_mission(api, api.post(f"/v1/{options.verb}"))


def _say_mission(api: Api, mission: Mapping[str, Any]) -> None:
    """Say what the robot does after a command, and what has become of its mission."""
    _say(api, f"{describe_stay(api.get('/v1/state'))}; {describe_mission(mission)}")


def _estop(options: Options, api: Api) -> None:
    mission = api.post("/v1/estop")["id"]
    _say(api, "emergency stop: sent, and repeated until the robot is switched off")
    if mission:
        print_line(f"mission {mission} has failed")


def _acknowledge(options: Options, api: Api) -> None:
    api.post("/v1/acknowledge")
    _say(api, "acknowledged: the next mission may fly; a landing close to the ground ends first")


def _drive(_: Options, api: Api) -> None:
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise BadInputError("mission drive needs a terminal; from a program use POST /v1/drive")
    import curses

    from cloudrc.doors.console.terminal import drive

    try:
        drive(api)
    except curses.error as error:
        raise BadInputError(f"mission drive: {error}; set TERM, for example to xterm") from None
    print_line("the drive has ended; to see what the robot does next: cloudrc mission status")


VERBS: dict[str, tuple[str, Callable[[Options, Api], int | None]]] = {
    "run": ("fly a mission and show its progress until the verdict", _run),
    "attach": ("follow a mission that flies, as 'run' does, until the verdict", _attach),
    "list": ("list all missions", _list),
    "status": ("show the robot's state, or the state of a mission", _status),
    "cancel": ("cancel a mission; the robot holds its position", _cancel),
    "logs": ("show the events of missions", _logs),
    "goto": ("go to a point; a held mission then holds there", _goto),
    "drive": ("drive the robot with the keys of this terminal", _drive),
    "hold": ("hold the robot where it is, at least 0.35 m above the ground", _order),
    "resume": ("resume the held mission", _order),
    "estop": ("switch off at once: a flying robot falls, and its mission fails", _estop),
    "acknowledge": (
        "allow flights again after a stop or a landing; does not start the robot",
        _acknowledge,
    ),
    "report": ("write the report of a mission of a release, as 'run' does", _report),
    "fly": ("fly a mission inside a Job: post it, follow it, exit with the verdict", _fly),
}
"""Verb -> help line, and function that carries it out."""


@contextmanager
def _forwarded_api(options: Options) -> Iterator[Api]:
    """Yield the API of a release, which is reachable over a forwarded port while the block runs.

    If the API does not answer, and after a status, say what the release suffers from.
    """
    from cloudrc.cluster.client import ClusterError
    from cloudrc.cluster.incidents import find_causes
    from cloudrc.cluster.missions import release_api
    from cloudrc.cluster.pods import NotRunningError

    release = need_release(options)
    try:
        with release_api(release, given_token(options)) as api:
            yield api
    except (UnreachableError, NotRunningError) as error:
        if causes := find_causes(release, thoroughly=False):
            raise ClusterError("; ".join(map(str, causes))) from error
        raise
    if options.verb == "status":
        print_lines(map(str, find_causes(release, thoroughly=False)), sys.stderr)


def _run_job(options: Options) -> int:
    """Create the Job of a mission; follow its log, and return the exit code of its verdict."""
    mission, release = read_mission(options.mission, options.name), need_release(options)
    from cloudrc.cluster.flight import begin_job

    job = begin_job(release, mission, print_line, options.timeout, queue=options.queue)
    if options.detach:
        where = " ".join([*release.flags, f"--release={release.name}"])
        print_line(f"follow it: cloudrc mission attach {job} {where}")
        return 0
    return _follow_job(release, job)


def _find_job(release: Release, name: str | None) -> str:
    """Return the Job `name`, by default the last one; "" if there is none: a mission is meant."""
    from cloudrc.cluster.jobs import COMPONENT, find_job

    if name:
        return name if find_job(release, name) else ""
    jobs = release.find("jobs", COMPONENT)
    jobs.sort(key=lambda job: str(job.metadata.creation_timestamp))
    return str(jobs[-1].metadata.name) if jobs else ""


def _follow_job(release: Release, job: str) -> int:
    """Follow the log of a mission's Job, and return the exit code of its verdict."""
    from cloudrc.cluster.fleet_mission import follow_fleet
    from cloudrc.cluster.flight import cancelling_command, follow_job
    from cloudrc.cluster.pods import fleet_size

    follow = follow_fleet if fleet_size(release) else follow_job
    try:
        return follow(release, job, print_line).exit_code
    except KeyboardInterrupt:
        remedy = cancelling_command(release, job)
        tell(f"Job {job} is still running; cancel its mission: {remedy}")
        raise
