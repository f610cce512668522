"""Serve the console's page: all browsers show the flight, one browser can control it.

viser draws and serves the page. It reports the release of a button, but not the release of a key.
Therefore, while the user holds a key, a script on the page holds the button of the same direction.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from math import inf
from typing import Any

import numpy as np
import rich
import viser

from cloudrc.config.load import ResolvedExperiment
from cloudrc.console.feed import STALE, FlightFeed
from cloudrc.console.steering import SLIDERS, Steering, is_drive
from cloudrc.errors import BadInputError
from cloudrc.geometry import fence
from cloudrc.geometry.clearance import Array
from cloudrc.geometry.scene import SPAWN, load_scene
from cloudrc.messages import ZERO, Quaternion, Vector

SLOW_PERIOD = 0.3
"""Time between two updates of the page, except for the moving bodies [s]."""
ANSWER_SHOWN = 8.0
"""Time for which an answer is shown [s]."""
PANEL_WIDTH = 330
"""Width of each panel beside the scene [px]."""
NARROW = 900
"""Width of the window below which the charts start collapsed [px]."""
ASPECT = (1280 - 2 * PANEL_WIDTH) / 800
"""Width divided by height of the scene between the panels, in a window of 1280 x 800 px."""
BLUE, RED, GREEN = "#0072b2", "#d55e00", "#009e73"
CHARTS: dict[str, tuple[float, float, dict[str, tuple[int, str]]]] = {
    "Delay [ms]": (1e3, 150, {"up": (1, BLUE), "down": (2, RED), "estimate": (3, GREEN)}),
    "Tracking error [m]": (1.0, 0.2, {"error": (4, BLUE)}),
    "Prediction error [mm]": (1e3, 20, {"error": (5, BLUE)}),
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
STOP, HOLD = "STOP", "Hold"
SCRIPT = """
const drive = %s;
const find = text =>
  [...document.querySelectorAll('button')].find(b => b.textContent.trim() === text);
const press = (kind, code) => find(drive[code])?.dispatchEvent(
  new PointerEvent(kind, {bubbles: true, button: 0, pointerId: 9}));
const held = new Set();
const release = code => held.delete(code) && (press('pointerup', code), find(drive[code])?.click());
const seize = e => (e.preventDefault(), e.stopImmediatePropagation());
document.title = 'cloudrc';
if (!window.cloudrc) {
  window.cloudrc = true;
  if (innerWidth < %d) document.querySelector('[aria-label="Collapse panel area"]')?.click();
  window.addEventListener('keydown', e => {
    if (e.ctrlKey || e.altKey || e.metaKey || !find('STOP')) return;
    if (e.code === 'KeyX' && e.shiftKey) return seize(e), find('STOP').click();
    if (e.target.closest('input, textarea')) return;
    if (e.code === 'Space') return seize(e), e.repeat || find('Hold').click();
    if (!(e.code in drive)) return;
    seize(e);
    if (!held.has(e.code)) held.add(e.code), press('pointerdown', e.code);
  }, true);
  window.addEventListener('keyup', e => {
    if (e.code in drive || e.code === 'Space') seize(e), release(e.code);
  }, true);
  window.addEventListener('blur', () => [...held].forEach(release));
}"""
STYLE = """
button[style*='red-filled'] {height: 60px !important; font-size: 24px; letter-spacing: 3px;
  background: #c4140c !important}
div:has(> button[style*='red-filled']) {position: sticky; top: 0; z-index: 9}
div:has(> button[style*='gray-filled']) {display: inline-block; width: 33.3%;
  margin: 0 !important; padding: 0 6px 6px !important}
div:has(+ div button[style*='red-filled']):not(:has(canvas)) {pointer-events: none;
  & :is(button, [role='button']) {visibility: hidden}}
.mantine-Notifications-root {z-index: 4 !important}
"""
"""Looks of the buttons. Of the last two rules, the first keeps the panel of STOP from being
collapsed or moved, the second keeps notifications from covering STOP."""


class Page:
    """The console's web page of one flight, at `url`; this process is its server."""

    def __init__(self, port: int) -> None:
        """Serve a page on this machine only; port 0 means any free port.

        Raises:
            BadInputError: If another program uses the port.
        """
        rich.get_console().quiet = True  # viser prints about itself
        self._server = viser.ViserServer("127.0.0.1", port, label="cloudrc", verbose=False)
        found = self._server.get_port()
        if found != port and port:  # viser has taken the next free port
            self._server.stop()
            raise BadInputError(f"--port {port}: is in use; name another port, or none")
        self.url = f"http://127.0.0.1:{found}"
        self._server.gui.configure_theme(show_share_button=False, show_logo=False)
        self._lock = threading.Lock()
        self._pilot: int | None = None  # the client that has the controls
        self._due = -inf  # time of the next slow update [s]
        self._touched = -inf  # when somebody last moved a slider [s]
        self._sliders: dict[str, Any] = {}
        self._target: tuple[Any, Any] | None = None  # gizmo and its numbers, until somebody moves
        self._drawn = 0  # number of drawn points of the trail

    def fill(self, experiment: ResolvedExperiment, feed: FlightFeed, steering: Steering) -> None:
        """Build the scene and the panels; only one browser at a time gets the controls."""
        self._experiment, self._feed, self._steering = experiment, feed, steering
        from cloudrc.console.scene import LEGEND, FlightScene  # needs MuJoCo, which takes a second

        self._scene = FlightScene(self._server, experiment, ASPECT)
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        self._status = gui.add_markdown("waiting for the robot", order=2)
        if load_scene(experiment.world.scene).pipes:
            gui.add_html(LEGEND, order=2.5)
        panel = gui.add_panel()
        with panel.add_tab("Charts"):
            self._charts = [self._add_chart(title) for title in CHARTS]
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._succeed)

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
                target[0].position = target[1].value = self._place_target(now)

    def close(self) -> None:
        """Stop serving the page."""
        self._server.stop()

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
        mission = state.get("mission")
        doing = "none"
        is_free = not mission or mission["by_hand"] or mission["state"] == "held"
        if is_free and self._steering.velocity(now) != ZERO:
            doing = "driving"
        elif is_drive(mission):
            doing = "drive, waits for keys"
        elif mission:
            reached = f"{len(mission['reached'])} of {mission['waypoints']} waypoints"
            doing = f"{mission['name'] or mission['id']}, {mission['state']}, {reached}"
        lines = [
            f"**{feed.status.guard.name}**: {feed.status.cause.words}",
            f"Last command: {'none' if age == inf else f'{age:.2f} s ago'}",
            f"Mission: {doing}",
        ]
        if silence > STALE:
            lines[0] = f"**No telemetry for {silence:.1f} s**, last: {lines[0]}"
        text, is_refusal, at = self._steering.answer
        if now - at < ANSWER_SHOWN:
            lines.append(f"**Refused:** {text}" if is_refusal else text)
        elif seen := state.get("seen"):
            lines.append(seen["next_step"])
        return "  \n".join(lines).replace("cloudrc mission ", "")  # buttons have the verbs' names

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
        gui, steering = client.gui, self._steering
        script = SCRIPT % ({code: label for code, (label, _) in KEYS.items()}, NARROW)
        shown = script.replace("&", "&amp;").replace('"', "&quot;")
        gui.add_html(f'<style onload="{shown}">{STYLE}</style>', order=9)
        stop = gui.add_button(STOP, color="red", order=0, hint="Stop the rotors (Shift+X)")

        @stop.on_click
        async def _(_: object) -> None:  # in the server's loop: it does not wait for other calls
            steering.stop()

        tabs = gui.add_tab_group(order=3)
        with tabs.add_tab("Fly"):
            self._add_mission(gui)
            self._add_target(client)
            self._add_keys(gui)
        with tabs.add_tab("Link"):
            self._add_link(gui)

    def _add_mission(self, gui: viser.GuiApi) -> None:
        steering = self._steering
        acts: dict[str, Callable[[], object]] = {
            "Start": self._start_mission,
            HOLD: lambda: steering.ask("holding", "/v1/hold"),
            "Resume": steering.resume,
            "Cancel": steering.cancel,
            "Acknowledge": lambda: steering.ask("acknowledged", "/v1/acknowledge"),
        }
        names = list(acts)
        for label, some in (("Mission", names[:3]), (" ", names[3:])):
            group = gui.add_button_group(label, some)

            @group.on_click
            def _(event: Any) -> None:
                acts[event.target.value]()

    def _start_mission(self) -> None:
        experiment, mission = self._experiment, self._experiment.mission
        if mission.steps is not None:
            text = "start: random steps are for 'cloudrc run'; send waypoints instead"
            self._steering.say(text, is_refusal=True)
            return
        order = mission.model_dump(mode="json", exclude={"steps"}, exclude_none=True)
        self._steering.fly({**order, "name": experiment.name})

    def _add_target(self, client: viser.ClientHandle) -> None:
        """Add a gizmo and number fields for the target position; a change of one updates both."""
        low, high, start = fence.INNER_LOW, fence.INNER_HIGH, self._place_target(time.monotonic())
        limits = tuple(zip(low, high, strict=True))
        gizmo = client.scene.add_transform_controls(
            "/target",
            scale=0.45,
            disable_rotations=True,
            translation_limits=limits,  # type: ignore[arg-type]
            depth_test=False,
            position=start,
        )
        numbers: Any = client.gui.add_vector3("Target [m]", start, step=0.01)
        send = client.gui.add_button("Send", hint="Fly to the target; a mission is held first")

        free = self._target = gizmo, numbers

        @gizmo.on_update
        def _(event: Any) -> None:
            if event.client is not None:  # somebody drags
                self._target = None
                x, y, z = map(float, np.round(gizmo.position, 2))
                numbers.value = (x, y, z)

        def move(event: Any) -> None:
            if event.client is not None:  # somebody has typed
                self._target = None
                gizmo.position = numbers.value

        numbers.on_update(move)

        @send.on_click
        def _(_: object) -> None:
            if self._steering.go_to(numbers.value):
                self._target = free

    def _place_target(self, now: float) -> Vector:
        """Return the position [m] for a target that no user has moved, inside the fence.

        It is the setpoint if cloud controls the robot, else the point 0.6 m above the robot.
        """
        feed = self._feed
        if (control := feed.control(now)) is not None:
            at: Any = control.setpoint
        else:
            at = np.add(feed.status.position if feed.status else SPAWN, (0, 0, 0.6))
        x, y, z = map(float, np.round(np.clip(at, fence.INNER_LOW, fence.INNER_HIGH), 2))
        return x, y, z

    def _add_keys(self, gui: viser.GuiApi) -> None:
        """Add the buttons for driving by hand; a held button repeats its key at 10 Hz."""
        steering = self._steering
        speed = gui.add_slider("Drive [m/s]", 0.1, 1.0, 0.1, 0.4)
        for code, (label, direction) in KEYS.items():
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
