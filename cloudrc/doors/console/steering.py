# SPDX-License-Identifier: Apache-2.0

"""Carry out what the operator asks for on the page or in a terminal, and watch missions and link.

The emergency stop, the drive and the changes of the link have threads of their own, with their own
connections: none of them waits for the page, or for another request.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple

from cloudrc.base.errors import CloudrcError
from cloudrc.wire.messages import ZERO, Vector

if TYPE_CHECKING:
    from cloudrc.teleop.client import Api

DRIVE_PERIOD = 0.1
"""Time between two requests of a drive [s], unless one takes longer; each is a heartbeat."""
STOP_PERIOD = 0.2
"""Time between two attempts to send an emergency stop that nobody has answered [s]."""
WATCH_PERIOD = 0.3
"""Time between two queries for the state of missions and link [s]."""
SLIDERS: dict[str, tuple[str, float, float, float]] = {
    "delay_ms": ("delay [ms]", 500.0, 1.0, 1.0),
    "jitter_ms": ("jitter [ms]", 100.0, 1.0, 1.0),
    "loss": ("loss [%]", 50.0, 0.5, 100.0),
}
"""Setting of a link direction -> label, largest value and step of its slider, and factor from the
setting's unit to that of the slider."""


VERBS = {
    "hold": "holding",
    "resume": "resumed",
    "cancel": "cancelled; the robot holds",
    "acknowledge": "acknowledged: the next mission may fly",
    "estop": "switching the robot off",
}
"""Verb of the operator, as in the path of teleop's API -> words of the answer."""


class Reply(NamedTuple):
    """Result of a request, for the operator."""

    text: str
    is_refusal: bool = False  # whether nothing was done
    at: float = -inf  # time of the answer [s]

    @property
    def words(self) -> str:
        """The text, which says so if nothing was done."""
        return f"not done: {self.text}" if self.is_refusal else self.text


NOTHING = Reply("")


@dataclass(frozen=True)
class LinkControl:
    """Functions for the emulated link, on this machine or in a cluster.

    Attributes:
        read: Returns the present profile, as in its file; {} if unknown.
        change: Applies settings such as "uplink.delay_ms=120"; raises a CloudrcError.
        note: Text after the settings in the page's answer: who applies them, if not `change`.
    """

    read: Callable[[], Mapping[str, Any]] = dict
    change: Callable[[Sequence[str]], object] = list
    note: str = ""


@dataclass
class Steering:
    """Sends the operator's requests.

    Attributes:
        api: Teleop's API; it keeps no connection open, so that several threads may use it.
        link: Functions that read and change the emulated link.
        answer: Result of the newest request.
        state: Newest answer of the API's `GET /v1/state`; {} before the first.
        route: Waypoints of the mission under way [m], shape (n, 3); empty if none.
        conditions: Key of the link, such as "uplink.delay_ms" -> present value, in the key's unit.
    """

    api: Api
    link: LinkControl = LinkControl()
    answer: Reply = NOTHING
    state: dict[str, Any] = field(default_factory=dict)
    route: list[Vector] = field(default_factory=list)
    conditions: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._stops, self._changed, self._moved = (threading.Event() for _ in range(3))
        self._drive = threading.Thread(target=self._drive_loop, daemon=True)
        self._drives = True
        self._held: dict[str, tuple[Vector, float]] = {}  # key -> velocity, and end of the hold
        self._turn: float | None = None  # yaw rate of the newest key [rad/s]
        self._changes: dict[str, float] = {}
        self._mission = ""

    def start(self) -> None:
        """Start the background threads; they do not keep the process alive."""
        self._drive.start()
        for loop in (self._stop_loop, self._link_loop, self._watch_loop):
            threading.Thread(target=loop, daemon=True).start()

    def end_drive(self) -> None:
        """Release all keys, and wait until the velocity zero has been sent to teleop."""
        self._drives = False
        self.release_keys()
        self._drive.join()

    def stop(self) -> None:
        """Switch the robot off, and repeat the request until the API answers; return at once."""
        self._stops.set()

    def ask(self, words: str, path: str, body: Mapping[str, Any] | None = None) -> Reply:
        """Post a request to `path` of the API; answer `words`, or with the reason of a refusal."""
        try:
            self.api.post(path, body)
        except CloudrcError as error:
            return self.say(str(error), is_refusal=True)
        return self.say(words)

    def say(self, text: str, *, is_refusal: bool = False) -> Reply:
        """Make `text` the newest answer; `is_refusal`: nothing was done."""
        self.answer = answer = Reply(text, is_refusal, time.monotonic())
        return answer

    def act(self, verb: str) -> Reply:
        """Carry out one of `VERBS`; "resume" also ends a drive by hand."""
        if verb == "cancel":
            return self._cancel()
        ends_drive = verb == "resume" and is_drive(self.state.get("mission"))
        words = "the drive ends, and the robot holds" if ends_drive else VERBS[verb]
        return self.ask(words, f"/v1/{verb}")

    def _cancel(self) -> Reply:
        """Cancel the mission under way, which may have begun after the last look."""
        try:
            mission = self.api.get("/v1/state")["mission"]
        except CloudrcError as error:
            return self.say(str(error), is_refusal=True)
        if mission is None:
            return self.say("no mission is under way", is_refusal=True)
        return self.ask(VERBS["cancel"], f"/v1/missions/{mission['id']}/cancel")

    def start_mission(self, order: Mapping[str, Any]) -> Reply:
        """Start a mission; if the user drives the robot by keys, first end this drive."""
        if is_drive(self.state.get("mission")):
            if (resumed := self.act("resume")).is_refusal:
                return resumed
            order = {**order, "queue": True}  # in case the drive has not ended yet
        back = order.get("start", "spawn") == "spawn"
        words = "starting; the robot is set back to its spawn" if back else "starting"
        return self.ask(words, "/v1/missions", order)

    def go_to(self, position: Sequence[float], yaw_deg: float | None = None) -> Reply:
        """Hold the present mission, if one is under way, then ask the robot to go to a position.

        `position` [m] has two numbers for a robot that stays on the ground; `yaw_deg` is the yaw
        there [deg], None for any.
        """
        mission = self.state.get("mission") or {"state": ""}
        if mission["state"] in ("starting", "flying"):
            if (held := self.act("hold")).is_refusal:
                return held
        place = [round(float(value), 3) for value in position]
        yaw = {} if yaw_deg is None else {"yaw_deg": round(yaw_deg, 1)}
        words = f"going to ({', '.join(f'{value:g}' for value in place)})"
        return self.ask(words, "/v1/goto", {"position_m": place, **yaw})

    def hold_key(self, key: str, velocity: Vector, lasts: float, turn: float | None = None) -> None:
        """Drive the robot with `velocity` [m/s] for `lasts` [s], because the user holds `key`.

        The velocities of several held keys add up. With a yaw rate `turn` [rad/s] the robot also
        turns, and the velocity is in the frame of its heading.
        """
        now = time.monotonic()
        before = self.velocity(now), self._turn
        self._held, self._turn = {**self._held, key: (velocity, now + lasts)}, turn
        if (self.velocity(now), turn) != before:
            self._moved.set()

    def release_keys(self, *keys: str) -> None:
        """Release the given keys; without arguments, release all keys."""
        held = self._held
        self._held = {key: held[key] for key in held.keys() - keys} if keys else {}
        self._moved.set()

    def velocity(self, now: float) -> Vector:
        """Return the sum of the velocities of all held keys [m/s]; `now` is the time [s]."""
        signs = [velocity for velocity, until in self._held.values() if now < until]
        x, y, z = (sum(parts) for parts in zip(ZERO, *signs, strict=True))
        return x, y, z

    def set_link(self, key: str, value: float) -> None:
        """Request a link change: set `key`, such as "uplink.delay_ms", to `value` [unit of key]."""
        self._changes[key] = value
        self._changed.set()

    def watch(self) -> None:
        """Query the state of missions and link once, and store it."""
        state, profile = dict[str, Any](), dict[str, Any]()
        try:
            state = self.api.get("/v1/state")
            mission = (state["mission"] or {"id": ""})["id"]
            if mission and mission != self._mission:
                self.route = self.api.get(f"/v1/missions/{mission}")["route_m"]
            self._mission = mission
            profile = {**self.link.read()}
        except CloudrcError as error:
            self.say(str(error), is_refusal=True)
        self.state = state
        self.conditions = {
            f"{way}.{name}": float(value)
            for way in ("uplink", "downlink")
            for name in SLIDERS
            if profile and isinstance(value := profile.get(way, {}).get(name, 0.0), int | float)
        }

    def _stop_loop(self) -> None:
        while self._stops.wait():
            if self.act("estop").is_refusal:
                time.sleep(STOP_PERIOD)
            else:
                self._stops.clear()

    def _drive_loop(self) -> None:
        """Send the velocity while a key is held, and once more when the last key is released."""
        moved = False
        while self._drives or moved:
            due = now = time.monotonic()
            due += DRIVE_PERIOD
            velocity, turn = self.velocity(now), self._turn
            if not any(now < until for _, until in self._held.values()):
                turn = None
            moves = velocity != ZERO or bool(turn)
            if moves or moved:
                words = "driving" if moves else "drive ends: holding"
                body: dict[str, Any] = {"velocity_mps": velocity}
                if turn is not None:
                    body["yaw_rate_radps"] = turn
                self.ask(words, "/v1/drive", body)
            moved = moves
            self._moved.wait(max(0.0, due - time.monotonic()))
            self._moved.clear()

    def _link_loop(self) -> None:
        """Apply new settings of the link; collect further settings while a change is under way."""
        while self._changed.wait():
            self._changed.clear()
            settings = []
            while self._changes:
                settings.append("{}={:g}".format(*self._changes.popitem()))
            try:
                if settings:
                    self.link.change(settings)
                    self.say(f"link: {', '.join(settings)}{self.link.note}")
            except CloudrcError as error:
                self.say(f"link: {error}", is_refusal=True)

    def _watch_loop(self) -> None:
        while True:
            self.watch()
            time.sleep(WATCH_PERIOD)


def is_drive(mission: Mapping[str, Any] | None) -> bool:
    """Return whether the user steers the robot by keys: the mission is hand-driven and held."""
    return mission is not None and mission["by_hand"] and mission["state"] == "held"
