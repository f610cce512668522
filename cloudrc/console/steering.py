"""Carry out what the operator asks for on the page, and watch the state of missions and link.

The emergency stop, the drive and the changes of the link have threads of their own, with their own
connections: none of them waits for the page, or for another request.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Any, Protocol

from cloudrc.errors import CloudrcError
from cloudrc.messages import ZERO, Vector

DRIVE_PERIOD = 0.1
"""Time between two requests of a drive [s]; each is a heartbeat of the operator."""
RELEASED = 0.3
"""Time without a sign of a held key after which it counts as released [s]."""
STOP_PERIOD = 0.2
"""Time between two attempts to send an emergency stop that nobody has answered [s]."""
WATCH_PERIOD = 0.4
"""Time between two looks at the state of missions and link [s]."""


class Api(Protocol):
    """The API of teleop; both methods raise a CloudrcError with the reason of a refusal."""

    def get(self, path: str) -> Any:
        """Send a GET request and return the decoded answer."""

    def post(self, path: str, body: Mapping[str, Any] | None = None) -> Any:
        """Send a POST request and return the decoded answer."""


@dataclass(frozen=True)
class Link:
    """The way to the emulated link, on this machine or in a cluster.

    Attributes:
        read: Returns "uplink.delay_ms" and the like -> the present value; {} if unknown.
        change: Applies settings such as "uplink.delay_ms=120"; raises a CloudrcError.
    """

    read: Callable[[], dict[str, float]]
    change: Callable[[Sequence[str]], object]


@dataclass
class Steering:
    """Sends the operator's requests; `answer` is the newest result in words.

    Attributes:
        api: Makes no connection that stays open, so that several threads may use it.
        link: The way to the emulated link.
        answer: Newest result in words, whether it is a refusal, and its time [s].
        state: Newest answer of the API's `GET /v1/state`; {} before the first.
        route: Waypoints of the mission under way [m], shape (n, 3); empty if none.
        conditions: Values that `Link.read` has returned last.
    """

    api: Api
    link: Link
    answer: tuple[str, bool, float] = ("", False, -inf)
    state: dict[str, Any] = field(default_factory=dict)
    route: list[Vector] = field(default_factory=list)
    conditions: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._stops, self._changed = threading.Event(), threading.Event()
        self._held: dict[str, tuple[Vector, float]] = {}  # key -> velocity and last sign of it
        self._changes: dict[str, float] = {}
        self._mission = ""

    def start(self) -> None:
        """Start the threads; they end with the process."""
        for loop in (self._stop_loop, self._drive_loop, self._link_loop, self._watch_loop):
            threading.Thread(target=loop, name=loop.__name__, daemon=True).start()

    def stop(self) -> None:
        """Stop the rotors, and repeat the request until the API answers; return at once."""
        self._stops.set()

    def ask(self, words: str, path: str, body: Mapping[str, Any] | None = None) -> bool:
        """Post a request, and tell the result in `answer`; return whether it was accepted."""
        try:
            self.api.post(path, body)
        except CloudrcError as error:
            self.say(f"{words}: {error}", is_refusal=True)
            return False
        self.say(words)
        return True

    def say(self, text: str, *, is_refusal: bool = False) -> None:
        """Show a text as the newest answer."""
        self.answer = text, is_refusal, time.monotonic()

    def cancel(self) -> None:
        """Cancel the mission under way."""
        if mission := self.state.get("mission"):
            self.ask("cancelled", f"/v1/missions/{mission['id']}/cancel")
        else:
            self.say("cancel: no mission is under way", is_refusal=True)

    def fly(self, order: Mapping[str, Any]) -> None:
        """Fly a mission; a drive that waits for keys ends first."""
        if is_drive(self.state.get("mission")):
            if not self.ask("ending the drive", "/v1/resume"):
                return
            order = {**order, "queue": True}  # in case the drive has not ended yet
        self.ask("starting", "/v1/missions", order)

    def go_to(self, position: Vector) -> None:
        """Fly to a position [m]; a mission that flies is held first."""
        x, y, z = (round(float(value), 3) for value in position)
        mission = self.state.get("mission") or {"state": ""}
        if mission["state"] in ("starting", "flying") and not self.ask("hold", "/v1/hold"):
            return
        self.ask(f"flying to ({x:g}, {y:g}, {z:g})", "/v1/goto", {"position_m": (x, y, z)})

    def hold_key(self, key: str, velocity: Vector) -> None:
        """Note that `key` is held; it adds `velocity` [m/s] to the drive. Call it repeatedly."""
        self._held[key] = velocity, time.monotonic()

    def release_key(self, key: str) -> None:
        """Note that `key` is released."""
        self._held.pop(key, None)

    def set_link(self, key: str, value: float) -> None:
        """Set `value` in the unit of `key`, "uplink.delay_ms" [ms], "uplink.loss" [1]; at once."""
        self._changes[key] = value
        self._changed.set()

    def velocity(self, now: float) -> Vector:
        """Return the sum of the velocities of all held keys [m/s]; `now` is the time [s]."""
        signs = [velocity for velocity, at in [*self._held.values()] if now - at < RELEASED]
        x, y, z = (sum(parts) for parts in zip(ZERO, *signs, strict=True))
        return x, y, z

    def _stop_loop(self) -> None:
        while self._stops.wait():
            if self.ask("stopping the rotors", "/v1/estop"):
                self._stops.clear()
            else:
                time.sleep(STOP_PERIOD)

    def _drive_loop(self) -> None:
        """Send the velocity while a key is held, and once more when the last key is released."""
        due, last = time.monotonic(), ZERO
        while True:
            due = max(due + DRIVE_PERIOD, time.monotonic())
            velocity = self.velocity(time.monotonic())
            if velocity != ZERO or last != ZERO:
                words = "driving" if velocity != ZERO else "drive ends: holding"
                self.ask(words, "/v1/drive", {"velocity_mps": velocity})
            last = velocity
            time.sleep(max(0.0, due - time.monotonic()))

    def _link_loop(self) -> None:
        """Apply the newest values; while a change is under way, later ones are collected."""
        while self._changed.wait():
            self._changed.clear()
            settings = []
            while self._changes:
                settings.append("{}={:g}".format(*self._changes.popitem()))
            try:
                if settings:
                    self.link.change(settings)
                    self.say(f"link: {', '.join(settings)}")
            except CloudrcError as error:
                self.say(f"link: {error}", is_refusal=True)

    def _watch_loop(self) -> None:
        while True:
            self.watch()
            time.sleep(WATCH_PERIOD)

    def watch(self) -> None:
        """Look at the state of missions and link once."""
        try:
            self.state = self.api.get("/v1/state")
            mission = (self.state["mission"] or {"id": ""})["id"]
            if mission and mission != self._mission:
                self.route = self.api.get(f"/v1/missions/{mission}")["route_m"]
            self._mission = mission
        except CloudrcError as error:
            self.state = {}
            self.say(str(error), is_refusal=True)
        self.conditions = self.link.read()


def is_drive(mission: Mapping[str, Any] | None) -> bool:
    """Return whether a mission is a drive by hand, which waits for keys."""
    return mission is not None and (mission["name"], mission["state"]) == ("drive", "held")
