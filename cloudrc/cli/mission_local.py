"""Run the verbs of `cloudrc mission` through teleop's API.

A command that follows a mission prints one line per event and exits with the code of the verdict.
The API may be unreachable for a while, because the cloud pod may be replaced in flight.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from cloudrc.cli.client import Api, UnreachableError, mission_path, token_file, token_reader
from cloudrc.cli.output import escape, format_document, print_line, table
from cloudrc.cli.pool import interrupt_on_signals
from cloudrc.drivers.machine import Deadline
from cloudrc.errors import BadInputError, CloudrcError

POLL_PERIOD = 0.5
"""Pause between two polls of a mission [s]."""
API_TIMEOUT = 180.0
"""Longest time for which the API may be unreachable [s]; a pod on another node first loads its
image."""
TURN_MAX = 30.0
"""Longest time for a request and the pause after it [s]. A longer time means that this process was
suspended."""
TERMINATION_LOG = Path("/dev/termination-log")
"""File in a pod; `kubectl describe` shows its text after the container has ended."""

_Answer = TypeVar("_Answer")


class WaitedTooLongError(CloudrcError):
    """Report that the API was unreachable for too long."""

    exit_code = 4


class MissionFollower:
    """Follow one mission, also across restarts of the API."""

    def __init__(
        self,
        api: Api,
        write: Callable[[str], None],
        patience: float | None = None,
    ) -> None:
        """Store the API; follow no mission yet.

        Args:
            api: Teleop's API.
            write: Receives a line for each event.
            patience: Longest time for which the API may be unreachable [s]; None for
                `API_TIMEOUT`.
        """
        self._api, self._write = api, write
        self._patience = API_TIMEOUT if patience is None else patience
        self._last_event = 0

    def post(self, mission: Mapping[str, Any]) -> dict[str, Any]:
        """Wait until the API answers, and post a mission; raise the errors of `Api.post`."""
        view = self._retry(lambda: self._api.post("/v1/missions", mission))
        self._write(f"mission {view['id']}: {view['state']}, waypoints: {view['waypoints']}")
        return dict(view)

    def follow(self, mission_id: str) -> dict[str, Any]:
        """Write the events of a mission until the mission has ended.

        Returns:
            The verdict as the API sends it.
        """
        while True:
            view = self._retry(lambda: self._api.get(mission_path(mission_id)))
            for event in view["events"]:
                if event["id"] > self._last_event:
                    self._last_event = event["id"]
                    self._write(f"{event['time_s']:7.2f} s  {event['text']}")
            if view["verdict"] is not None:
                return dict(view["verdict"])
            time.sleep(POLL_PERIOD)

    def _retry(self, request: Callable[[], _Answer]) -> _Answer:
        """Repeat a request until the API answers or was unreachable for too long."""
        deadline, reported = Deadline(self._patience, TURN_MAX), False
        while True:
            try:
                return request()
            except UnreachableError as error:
                if deadline.passed():
                    raise WaitedTooLongError(
                        f"{error}; gave up after {self._patience:g} s"
                    ) from None
                if not reported:
                    self._write(f"{error}; waiting")
                    reported = True
            time.sleep(POLL_PERIOD)


def describe_verdict(verdict: Mapping[str, Any]) -> str:
    """Describe a verdict in one line."""
    word = verdict["outcome"].upper()
    failures = [f"{failure['code']}: {failure['text']}" for failure in verdict["failures"]]
    if not failures:
        return f"{word}: every waypoint reached, every criterion met"
    return f"{word}: {'; also '.join(failures)}"


def write_termination_message(text: str, path: Path = TERMINATION_LOG) -> None:
    """Write the termination message for Kubernetes, if this is a pod."""
    try:
        if path.exists():
            path.write_text(text + "\n", encoding="utf-8")
    except OSError:
        pass  # Kubernetes then falls back to the last line of the log, which says the same


INTERRUPTED = 130


def read_mission(name: str) -> dict[str, Any]:
    """Read a mission that cloudrc ships, or a mission file; the API checks the content.

    Raises:
        BadInputError: If the file does not exist, or if it holds no mission.
    """
    from cloudrc.config import shipped

    mission = dict(shipped.read("mission", name, Path()).tree)
    if mission.get("steps") is not None:
        raise BadInputError(
            f"{name}: steps are for experiments; fly them with 'cloudrc run', or give waypoints"
        )
    mission.pop("steps", None)
    return {"name": Path(name).stem, **mission}


def fly(options: argparse.Namespace) -> int:
    """Post a mission and follow it until its verdict; cancel it on Ctrl-C."""
    if options.api is None:
        raise BadInputError("fly needs --api; without a Job use: cloudrc mission run FILE")
    interrupt_on_signals()
    api = Api(options.api, token_reader(token_file(options)))
    follower, mission_id = MissionFollower(api, print_line), ""
    try:
        mission = read_mission(options.mission)
        order = {**mission, "key": options.key, "queue": options.queue}
        mission_id = follower.post(order)["id"]
        verdict = follower.follow(mission_id)
    except KeyboardInterrupt:
        if mission_id:
            with suppress(CloudrcError):
                api.post(f"{mission_path(mission_id)}/cancel")
        _end("INTERRUPTED: the Job was stopped, its mission is cancelled")
        return INTERRUPTED
    except CloudrcError as error:
        write_termination_message(str(error))
        raise
    _end(describe_verdict(verdict))
    return int(verdict["exit_code"])


def _run(options: argparse.Namespace, api: Api) -> int:
    mission = read_mission(options.mission)
    if options.name:
        mission["name"] = options.name
    follower = MissionFollower(api, print_line, patience=10.0)
    mission_id = follower.post({**mission, "queue": options.queue})["id"]
    try:
        verdict = follower.follow(mission_id)
    except KeyboardInterrupt:
        state = "is waiting or flying" if options.queue else "is still flying"
        command = f"cloudrc mission cancel {mission_id}"
        print_line(f"mission {mission_id} {state}; cancel it: {command}", sys.stderr)
        raise
    print_line(describe_verdict(verdict))
    return int(verdict["exit_code"])


def _list(options: argparse.Namespace, api: Api) -> int:
    missions = api.get("/v1/missions")["missions"]
    if options.output != "table":
        return _print({"missions": missions}, options.output)
    if not missions:
        print("no missions yet")
        return 0
    heads = ("ID", "NAME", "STATE", "WAYPOINTS", "VERDICT")
    print(table([heads, *map(_row, missions)]))
    return 0


def _row(mission: dict[str, Any]) -> tuple[str, ...]:
    done = f"{len(mission['reached'])}/{mission['waypoints']}"
    verdict = describe_verdict(mission["verdict"]) if mission["verdict"] else ""
    return mission["id"], mission["name"], mission["state"], done, verdict


def _status(options: argparse.Namespace, api: Api) -> int:
    if options.id:
        mission = api.get(mission_path(options.id))
        if options.output != "table":
            return _print(mission, options.output)
        _print_state(mission)
        _print_history(mission)
        return 0
    state = api.get("/v1/state")
    if options.output != "table":
        return _print(state, options.output)
    if state["mission"]:
        _print_state(state["mission"])
    else:
        print("no mission is under way")
    if state["queue"]:
        print_line(f"waiting: {', '.join(state['queue'])}")
    _print_robot(state["seen"], state["cloud_age_s"])
    return 0


def _cancel(options: argparse.Namespace, api: Api) -> int:
    mission_id = options.id
    if not mission_id:
        mission = api.get("/v1/state")["mission"]
        if mission is None:
            raise BadInputError("no mission is under way; 'cloudrc mission list' shows all")
        mission_id = mission["id"]
    _print_state(api.post(f"{mission_path(mission_id)}/cancel"))
    return 0


def _logs(options: argparse.Namespace, api: Api) -> int:
    if not options.follow and options.id:
        _print_history(api.get(mission_path(options.id)))
        return 0
    if not options.follow:
        missions = [m["id"] for m in api.get("/v1/missions")["missions"]]
        events = [e for m in missions for e in api.get(mission_path(m))["events"]]
        _print_events(sorted(events, key=lambda event: int(event["id"])))
        return 0
    for event in api.events():
        if not options.id or event["mission"] == options.id:
            _print_events([event])
    return 0


def _goto(options: argparse.Namespace, api: Api) -> int:
    body = {"position_m": [options.x, options.y, options.z]}
    _print_state(api.post("/v1/goto", body))
    return 0


def _hold(options: argparse.Namespace, api: Api) -> int:
    _print_state(api.post("/v1/hold"))
    return 0


def _resume(options: argparse.Namespace, api: Api) -> int:
    _print_state(api.post("/v1/resume"))
    return 0


def _estop(options: argparse.Namespace, api: Api) -> int:
    mission = api.post("/v1/estop")["id"]
    print("emergency stop: sent, and repeated until the rotors have stopped", flush=True)
    if mission:
        print_line(f"mission {mission} has failed")
    return 0


def _acknowledge(options: argparse.Namespace, api: Api) -> int:
    api.post("/v1/acknowledge")
    print(
        "acknowledged: the next mission may fly; a landing close to the ground is completed first"
    )
    print(
        "after a stop or a touchdown the robot takes off only once it is at rest, and at least "
        "0.5 m inside the fence"
    )
    return 0


VERBS: dict[str, Callable[[argparse.Namespace, Api], int]] = {
    "run": _run,
    "list": _list,
    "status": _status,
    "cancel": _cancel,
    "logs": _logs,
    "goto": _goto,
    "hold": _hold,
    "resume": _resume,
    "estop": _estop,
    "acknowledge": _acknowledge,
}


def _print_state(mission: dict[str, Any]) -> None:
    """Print the state of a mission in one line."""
    where = f"waypoint {mission['waypoint'] + 1} of {mission['waypoints']}"
    name = f" ({mission['name']})" if mission["name"] else ""
    verdict = f"; {describe_verdict(mission['verdict'])}" if mission["verdict"] else ""
    print_line(f"mission {mission['id']}{name}: {mission['state']}, {where}{verdict}")


def _print_robot(seen: dict[str, Any] | None, cloud_age: float | None) -> None:
    """Print the robot's position, its state, the time since its last telemetry, the next step.

    Args:
        seen: The newest telemetry.
        cloud_age: Time since the last message from cloud [s]; None if there was none.
    """
    heard = "never" if cloud_age is None else f"{cloud_age:.1f} s ago"
    if seen is None:
        print(f"no telemetry from the robot yet; is the link up? cloud heard {heard}")
        return
    where = ", ".join("?" if value is None else f"{value:.2f}" for value in seen["position_m"])
    if seen["guard_for_s"] is None:
        past = f"robot not heard for {seen['age_s']:.1f} s (guard {seen['guard']} then)"
        print_line(f"{past}; cloud heard {heard}")
        print_line(f"last seen at ({where}) m: {seen['cause']}")
    else:
        rtt = "" if seen["rtt_s"] is None else f", round trip {seen['rtt_s'] * 1e3:.0f} ms"
        print_line(f"robot at ({where}) m, seen {seen['age_s']:.2f} s ago{rtt}")
        print_line(f"guard {seen['guard']} for {seen['guard_for_s']:.1f} s: {seen['cause']}")
    print_line(f"next: {seen['next_step']}")


def _print_history(mission: dict[str, Any]) -> None:
    if left_out := mission.get("events_left_out", 0):
        print_line(f"{mission['id']:<4}{left_out} earlier events are not shown")
    _print_events(mission["events"])


def _print_events(events: list[dict[str, Any]]) -> None:
    for event in events:
        print_line(f"{event['mission']:<4}{event['time_s']:8.2f} s  {event['text']}")


def _print(document: dict[str, Any], form: str) -> int:
    print(format_document({"schemaVersion": 1, **document}, form))
    return 0


def _end(text: str) -> None:
    print_line(text)
    write_termination_message(escape(text))
