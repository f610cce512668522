"""Serve the console's page: all browsers show the flight, one browser can control it.

The door (`console/door.py`) serves the page and its STOP, viser draws the scene and the panels.
viser reports the release of a button, but not the release of a key. Therefore, while the user holds
a key, a script of the page (`console/web/scene.js`) holds the button of the same direction.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from functools import partial
from math import inf
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np
import rich
import viser

from cloudrc.config.load import ResolvedExperiment
from cloudrc.config.scene import scene_of
from cloudrc.console.access import PARAMETER, Access
from cloudrc.console.door import Desk, Door, scene_page, viser_at
from cloudrc.console.feed import STALE, FlightFeed
from cloudrc.console.steering import SLIDERS, Steering, is_drive
from cloudrc.geometry.clearance import Array
from cloudrc.geometry.obstacles import fence_of
from cloudrc.messages import ZERO, Quaternion, Vector
from cloudrc.text import describe_sensors

SLOW_PERIOD = 0.3
"""Time between two updates of the page, except for the moving bodies [s]."""
ANSWER_SHOWN = 8.0
"""Time for which an answer is shown [s]."""
PANEL_WIDTH = 330
"""Width of each panel beside the scene [px]."""
ASPECT = (1280 - 2 * PANEL_WIDTH) / 800
"""Width divided by height of the scene between the panels, in a window of 1280 x 800 px."""
BLUE, RED, GREEN = "#0072b2", "#d55e00", "#009e73"
CHARTS: dict[str, tuple[float, float, dict[str, tuple[int, str]]]] = {
    "Delay [ms]": (1e3, 150, {"up": (1, BLUE), "down": (2, RED), "estimate": (3, GREEN)}),
    "Tracking error [m]": (1.0, 0.2, {"error": (4, BLUE)}),
    "Estimate error [mm]": (1e3, 20, {"error": (5, BLUE)}),
    "Speed [m/s]": (1.0, 0.5, {"speed": (6, BLUE)}),
}
"""Title of a chart -> factor from SI units, smallest range of its axis, and its curves: name ->
place in `Sample`, and colour."""
KEYS: dict[str, tuple[str, Vector]] = {
    "KeyW": ("W up", (0.0, 0.0, 1.0)),
    "ArrowUp": ("↑ +x", (1.0, 0.0, 0.0)),
    "KeyS": ("S down", (0.0, 0.0, -1.0)),
    "ArrowLeft": ("← +y", (0.0, 1.0, 0.0)),
    "ArrowDown": ("↓ -x", (-1.0, 0.0, 0.0)),
    "ArrowRight": ("→ -y", (0.0, -1.0, 0.0)),
}
"""Key, as browsers name it -> label of its button, and direction of the drive."""
RELEASED = 0.3
"""Time after the last call from a held button at which its key counts as released [s]."""
HOLD = "Hold"
BELOW_STOP = '<div style="height: 36px"></div>'
"""Keeps the panel's first lines below STOP, which lies over the panel."""


class Page:
    """The console's web page of one flight, at `url`; this process is its server."""

    def __init__(
        self,
        port: int,
        token: Callable[[], str] | None = None,
        origins: Collection[str] = (),
    ) -> None:
        """Serve a page on this machine only.

        Args:
            port: TCP port; 0 means any free port.
            token: Function that returns the page's present token; None makes one.
            origins: Origins of proxies that may serve the page.

        Raises:
            BadInputError: If the port cannot be opened.
        """
        own = token_hex(16)
        self._access = Access(token or (lambda: own), origins)
        acts = {name.lower(): partial(self._answer, act) for name, act in self._acts().items()}
        desk = Desk(self._stop, acts, self._describe_plainly, lambda: self._pilot is not None)
        self._filled = threading.Event()
        viser_page = Path(viser.__file__).parent / "client" / "build" / "index.html"
        labels = {code: label for code, (label, _) in KEYS.items()}
        scene = scene_page(viser_page.read_text(encoding="utf-8"), labels)
        self._door = Door(port, self._access, desk, scene)
        rich.get_console().quiet = True  # viser prints about itself
        with viser_at(self._door.viser):
            self._server = viser.ViserServer(label="cloudrc", verbose=False)
        self._server.gui.configure_theme(show_share_button=False, show_logo=False)
        self._lock = threading.Lock()
        self._pilot: int | None = None  # the client that has the controls
        self._due = -inf  # time of the next slow update [s]
        self._touched = -inf  # when somebody last moved a slider [s]
        self._sliders: dict[str, Any] = {}
        self._target: tuple[Any, Any] | None = None  # gizmo and its numbers, until somebody moves
        self._drawn = 0  # number of drawn points of the trail
        self._door.open()

    @property
    def port(self) -> int:
        """The TCP port of the page."""
        return self._door.port

    @property
    def url(self) -> str:
        """The page's address, with the token."""
        return f"http://127.0.0.1:{self.port}/?{PARAMETER}={self._access.token()}"

    def fill(self, experiment: ResolvedExperiment, feed: FlightFeed, steering: Steering) -> None:
        """Build the scene and the panels; only one browser at a time gets the controls."""
        self._experiment, self._feed, self._steering = experiment, feed, steering
        from cloudrc.console.scene import LEGEND, FlightScene
        from cloudrc.world.shapes import read_shapes  # needs MuJoCo, which takes a second

        shapes = read_shapes(experiment.world)
        self._planar = shapes.planar
        self._surroundings = scene_of(experiment.world)
        self._scene = FlightScene(self._server, experiment, shapes, self._surroundings, ASPECT)
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        gui.add_html(BELOW_STOP, order=-1)
        self._status = gui.add_markdown("waiting for the robot", order=2)
        if self._surroundings.tubes:
            gui.add_html(LEGEND, order=2.5)
        panel = gui.add_panel()
        with panel.add_tab("Charts"):
            self._charts = [self._add_chart(title) for title in CHARTS]
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._succeed)
        self._filled.set()

    def update(self, now: float) -> None:
        """Show the present state; `now` is the time [s], on the clock of the feed."""
        feed, scene = self._feed, self._scene
        with self._server.atomic():
            if (status := feed.status) is not None:
                scene.move("robot", *_visible(status.position, status.orientation_wxyz))
            control = feed.control(now)
            ghost = control and _visible(control.position, control.orientation_wxyz)
            scene.move("ghost", *(ghost or (None,)))
            scene.move("setpoint", control.setpoint if control else None)
        if now < self._due:
            return
        self._due = now + SLOW_PERIOD
        columns = feed.columns()
        for chart, (factor, _, curves) in zip(self._charts, CHARTS.values(), strict=True):
            rows = [_with_gaps(columns[place] * factor) for place, _ in curves.values()]
            # Not chart.data: it would make numbers of the values that are unknown.
            chart._queue_update("data", (columns[0], *rows))
        if feed.flown != self._drawn:
            self._drawn = feed.flown
            scene.set_trail(*feed.trail())
        mission, route = self._steering.state.get("mission"), self._steering.route
        if not (mission and route):
            route = [point.position_m for point in self._experiment.mission.waypoints]
        scene.set_waypoints(np.array(route), len(mission["reached"]) if mission else 0)
        self._status.content = self._describe(now)
        with suppress(RuntimeError):  # viser has just removed the controls of a browser that left
            self._follow_link(now)
            if target := self._target:
                target[0].position = place = self._place_target(now)
                target[1].value = self._without_height(place)

    def close(self) -> None:
        """Stop serving the page."""
        self._door.close()
        self._server.stop()

    def _stop(self) -> bool:
        """Switch the robot off, do not wait; return False before the page is filled."""
        if self._filled.is_set():
            self._steering.stop()
        return self._filled.is_set()

    def _add_chart(self, title: str) -> Any:
        _, span, curves = CHARTS[title]
        lines: list[Any] = [
            {"label": name, "stroke": colour, "width": 1.5} for name, (_, colour) in curves.items()
        ]
        low = {"hard": 0, "soft": 0, "mode": 1, "pad": 0}
        high = {"soft": span, "mode": 1, "pad": 0.1}
        return self._server.gui.add_uplot(
            (np.zeros(1),) * (1 + len(curves)),
            ({"label": "s"}, *lines),
            title=title,
            scales={"x": {"time": False}, "y": {"range": {"min": low, "max": high}}},
            axes=({"size": 30}, {"size": 46}),
            legend={"show": len(curves) > 1, "live": False},
            padding=(10, 16, 0, 0),
            height=132,
        )

    def _describe(self, now: float) -> str:
        """Return guard, command age, mission and the newest answer, as Markdown."""
        feed, state = self._feed, self._steering.state
        if feed.status is None:
            return "**waiting for the robot**"
        silence, age = feed.silence(now), feed.command_age(now)
        lines = [
            f"**{feed.status.guard.name}**: {feed.status.cause.words}",
            f"Last command: {'none' if age == inf else f'{age:.2f} s ago'}",
            f"Mission: {self._describe_mission(now)}",
        ]
        if shown := describe_sensors((state.get("seen") or {}).get("sensors", ())):
            lines.append(f"Sensors: {shown}")
        if silence > STALE:
            lines[0] = f"**No telemetry for {silence:.1f} s**, last: {lines[0]}"
        text, is_refusal, at = self._steering.answer
        if now - at < ANSWER_SHOWN:
            lines.append(f"**Refused:** {text}" if is_refusal else text)
        elif seen := state.get("seen"):
            lines.append(seen["next_step"])
        return "  \n".join(lines).replace("cloudrc mission ", "")  # buttons have the verbs' names

    def _describe_mission(self, now: float) -> str:
        mission = self._steering.state.get("mission")
        is_free = not mission or mission["by_hand"] or mission["state"] == "held"
        if is_free and self._steering.velocity(now) != ZERO:
            return "driving"
        if is_drive(mission):
            return "drive, waits for keys"
        if not mission:
            return "none"
        progress = "setpoints of a file"
        if mission["waypoints"]:
            progress = f"{len(mission['reached'])} of {mission['waypoints']} waypoints"
        return f"{mission['name'] or mission['id']}, {mission['state']}, {progress}"

    def _follow_link(self, now: float) -> None:
        """Show the link's present state on the sliders, unless somebody is moving a slider."""
        if now - self._touched < 2.0:
            return
        for key, slider in self._sliders.items():
            value = self._steering.conditions.get(key)
            if value is not None:
                shown = min(value * SLIDERS[key.partition(".")[2]][-1], slider.max)
                if abs(slider.value - shown) > 1e-6:
                    slider.value = shown

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Give the controls to a new browser if no other browser has them."""
        with self._lock:
            is_pilot = self._pilot is None
            if is_pilot:
                self._pilot = client.client_id
        if is_pilot:
            self._add_controls(client)
        else:
            client.gui.add_markdown("**Read only**: another browser steers.", order=0)

    def _succeed(self, client: viser.ClientHandle) -> None:
        """Give the controls to another browser if the browser that had them has left."""
        with self._lock:
            if self._pilot != client.client_id:
                return
            self._pilot, self._sliders, self._target = None, {}, None
        for other in self._server.get_clients().values():
            other.gui.reset()
            self._welcome(other)

    def _add_controls(self, client: viser.ClientHandle) -> None:
        gui = client.gui
        tabs = gui.add_tab_group(order=3)
        with tabs.add_tab("Steer"):
            self._add_mission(gui)
            self._add_target(client)
            self._add_keys(gui)
        with tabs.add_tab("Link"):
            self._add_link(gui)

    def _add_mission(self, gui: viser.GuiApi) -> None:
        acts = self._acts()
        names = list(acts)
        for label, some in (("Mission", names[:3]), (" ", names[3:])):
            group = gui.add_button_group(label, some)

            @group.on_click
            def _(event: Any) -> None:
                acts[event.target.value]()

    def _acts(self) -> dict[str, Callable[[], object]]:
        """Return the label of each button of a mission, and what it does."""
        return {
            "Start": self._start_mission,
            HOLD: lambda: self._steering.ask("holding", "/v1/hold"),
            "Resume": lambda: self._steering.resume(),
            "Cancel": lambda: self._steering.cancel(),
            "Acknowledge": lambda: self._steering.ask("acknowledged", "/v1/acknowledge"),
        }

    def _answer(self, act: Callable[[], object]) -> str:
        """Do what a button of the plain page asks for; return the answer in words."""
        if not self._filled.is_set():
            return "the console starts; ask again"
        act()
        text, is_refusal, _ = self._steering.answer
        return f"Refused: {text}" if is_refusal else text

    def _describe_plainly(self) -> list[str]:
        """Return the lines of the state, without marks."""
        if not self._filled.is_set():
            return ["the console starts"]
        text = self._describe(time.monotonic()).replace("**", "")
        return text.split("  \n")

    def _start_mission(self) -> None:
        experiment, mission = self._experiment, self._experiment.mission
        if mission.steps is not None:
            text = "start: random steps are for 'cloudrc run'; send waypoints instead"
            self._steering.say(text, is_refusal=True)
            return
        order = mission.model_dump(mode="json", exclude={"steps"}, exclude_none=True)
        self._steering.start_mission({**order, "name": experiment.name})

    def _add_target(self, client: viser.ClientHandle) -> None:
        """Add a gizmo and number fields for the target position; a change of one updates both."""
        start = self._place_target(time.monotonic())
        limits = tuple(zip(*self._limits(), strict=True))
        gizmo = client.scene.add_transform_controls(
            "/target",
            scale=0.45,
            disable_rotations=True,
            active_axes=(True, True, not self._planar),
            translation_limits=limits,  # type: ignore[arg-type]
            depth_test=False,
            position=start,
        )
        numbers = self._add_place(client.gui, start)
        send = client.gui.add_button("Send", hint="Go to the target; a mission is held first")

        free = self._target = gizmo, numbers

        @gizmo.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # somebody drags
                self._target = None
                numbers.value = self._without_height(np.round(gizmo.position, 2))

        def move(event: Any) -> None:
            if event.client is not None:  # somebody has typed
                self._target = None
                gizmo.position = (*numbers.value, gizmo.position[2])[:3]

        numbers.on_update(move)

        @send.on_click
        def _(_: object) -> None:
            if self._steering.go_to(numbers.value):
                self._target = free

    def _add_place(self, gui: viser.GuiApi, start: Vector) -> Any:
        """Add number fields for the target: three, or two for a robot that stays on the ground."""
        add = gui.add_vector2 if self._planar else gui.add_vector3
        return add("Target [m]", self._without_height(start), step=0.01)

    def _without_height(self, place: Any) -> Any:
        """Return a place [m] as the number fields show it."""
        return tuple(map(float, place[:2] if self._planar else place))

    def _place_target(self, now: float) -> Vector:
        """Return the position [m] for a target that no user has moved, inside the fence.

        It is the setpoint if cloud controls the robot, else the point 0.6 m above the robot, or the
        robot's own place on the ground.
        """
        feed = self._feed
        if (control := feed.control(now)) is not None:
            at: Any = control.setpoint
        else:
            here = feed.status.position if feed.status else self._surroundings.spawn
            at = np.add(here, (0, 0, 0 if self._planar else 0.6))
        x, y, z = map(float, np.round(np.clip(at, *self._limits()), 2))
        return x, y, z

    def _limits(self) -> tuple[Vector, Vector]:
        """Return the corners of the box for targets [m], with the smallest coordinates first."""
        fence, ground = fence_of(self._surroundings), self._surroundings.spawn[2]
        if not self._planar:
            return fence.inner_low, fence.inner_high
        return (*fence.inner_low[:2], ground), (*fence.inner_high[:2], ground)

    def _add_keys(self, gui: viser.GuiApi) -> None:
        """Add the buttons for driving by hand; a held button repeats its key at 10 Hz."""
        steering = self._steering
        speed = gui.add_slider("Drive [m/s]", 0.1, 1.0, 0.1, 0.4)
        for code, (label, direction) in KEYS.items():
            if self._planar and direction[2]:
                continue  # the key has no button, so it does nothing
            button = gui.add_button(label, color="gray")

            @button.on_hold
            async def _(_: object, code: str = code, direction: Vector = direction) -> None:
                x, y, z = (part * _clamp(speed) for part in direction)
                steering.hold_key(code, (x, y, z), RELEASED)

            @button.on_click
            async def _(_: object, code: str = code) -> None:
                steering.release_keys(code)

    def _add_link(self, gui: viser.GuiApi) -> None:
        sliders = {}
        for way in ("uplink", "downlink"):
            for name, (label, largest, step, factor) in SLIDERS.items():
                key = f"{way}.{name}"
                label = f"{way.removesuffix('link').title()} {label}"
                slider = sliders[key] = gui.add_slider(label, 0.0, largest, step, 0.0)

                @slider.on_update
                async def _(event: Any, key: str = key, factor: float = factor) -> None:
                    if event.client is not None:
                        self._touched = time.monotonic()
                        self._steering.set_link(key, _clamp(event.target) / factor)

        self._sliders = sliders  # complete: the main thread goes through them


def _clamp(slider: Any) -> float:
    """Limit the value of a slider, whose number field accepts any number; return the value."""
    value = float(np.clip(slider.value, slider.min, slider.max))
    if value != slider.value:
        slider.value = value
    return value


def _with_gaps(curve: Array) -> list[float | None]:
    """Replace each NaN by None, which is a gap in the chart.

    If all are NaN, make the first value -1: the chart draws its axes only if it has a number. The
    value is below the visible range.
    """
    values = [None if value != value else value for value in curve.tolist()]
    return [-1.0, *values[1:]] if not any(value is not None for value in values) else values


def _visible(position: Vector, orientation_wxyz: Quaternion) -> tuple[Any, Any]:
    """Round a pose to steps too small to see, so that the browser redraws only a moving robot."""
    return np.round(position, 3), np.round(orientation_wxyz, 3)
