# SPDX-License-Identifier: Apache-2.0

"""Serve the console's page: all browsers show the flight, one browser can control it.

The door (`console/door.py`) serves the page and its STOP, viser draws the scene and the panels.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Collection
from math import inf
from pathlib import Path
from secrets import token_hex
from typing import Any

import numpy as np
import rich
import viser

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.doors.console.access import PARAMETER, Access
from cloudrc.doors.console.controls import KEYS, Controls, acts_of
from cloudrc.doors.console.door import Door, scene_page, viser_at
from cloudrc.doors.console.feed import (
    CHARTED_FROM,
    DOWNLINK,
    ERROR,
    ESTIMATE,
    SPEED,
    UPLINK,
    FlightFeed,
)
from cloudrc.doors.console.steering import Steering, is_drive
from cloudrc.physics.geometry.clearance import Array
from cloudrc.results.metrics.definitions import CHARTED
from cloudrc.results.report.scene import LEGEND, FlightScene
from cloudrc.results.report.shapes import read_shapes
from cloudrc.teleop.client import describe_mission
from cloudrc.teleop.telling import describe_robot
from cloudrc.wire.messages import ZERO, Quaternion, Vector
from cloudrc.wire.pictures import Image

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
    "Delay [ms]": (
        1e3,
        150,
        {"up": (UPLINK, BLUE), "down": (DOWNLINK, RED), "estimate": (ESTIMATE, GREEN)},
    ),
    "Estimate error [mm]": (1e3, 20, {"error": (ERROR, BLUE)}),
    "Speed [m/s]": (1.0, 0.5, {"speed": (SPEED, BLUE)}),
}
"""Title of a chart -> factor from SI units, smallest range of its axis, and its curves: name ->
row of `FlightFeed.columns`, and colour."""
for _row, _quantity in enumerate(CHARTED, start=CHARTED_FROM):
    _title, _factor, _range = _quantity.chart or ("", 1.0, 1.0)
    CHARTS[_title] = _factor, _range, {_title.partition(" [")[0].lower(): (_row, BLUE)}
BELOW_STOP = '<div style="height: 36px"></div>'
"""Keeps the panel's first lines below STOP, which lies over the panel."""


class Page:
    """The console's web page of one flight, at `url`; this process is its server.

    Attributes:
        steering: Carries out what the page asks for.
        acts: Name of a button -> what it does.
        pilot: Number of the browser that has the controls; None: no page with the scene steers.
    """

    def __init__(
        self,
        experiment: ResolvedExperiment,
        feed: FlightFeed,
        steering: Steering,
        port: int = 0,
        token: Callable[[], str] | None = None,
        origins: Collection[str] = (),
        host: str = "127.0.0.1",
    ) -> None:
        """Serve the page at the address `host`; one browser at a time gets the controls.

        Args:
            experiment: What flies.
            feed: What the page shows.
            steering: Carries out what the page asks for.
            port: TCP port; 0 means any free port.
            token: Function that returns the page's present token; None makes one.
            origins: Origins of proxies that may serve the page.
            host: IP address to listen at, by default this machine's own.
        """
        own = token_hex(16)
        self._access = Access(token or (lambda: own), origins)
        self._experiment, self._feed, self.steering = experiment, feed, steering
        self.acts = acts_of(experiment, steering)
        self.pilot: int | None = None
        viser_page = Path(viser.__file__).parent / "client" / "build" / "index.html"
        labels = {code: label for code, (label, _) in KEYS.items()}
        html = scene_page(viser_page.read_text(encoding="utf-8"), labels)
        self._door = Door((host, port), self._access, self, html)
        rich.get_console().quiet = True  # viser prints about itself
        with viser_at(self._door.viser):
            self._server = viser.ViserServer(label="cloudrc", verbose=False)
        self._lock = threading.Lock()
        self._controls: Controls | None = None
        self._due = -inf  # time of the next slow update [s]
        self._drawn = 0  # number of drawn points of the trail
        self._picture: viser.GuiImageHandle | None = None
        scene, shapes = experiment.scene, read_shapes(experiment.world)
        self._scene = FlightScene(self._server, experiment, shapes, scene, ASPECT)
        self._add_panels(with_legend=bool(scene.tubes))
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._succeed)
        self._door.start()

    @property
    def port(self) -> int:
        """The TCP port of the page."""
        return self._door.port

    @property
    def url(self) -> str:
        """The page's address, with the token."""
        return f"http://127.0.0.1:{self.port}/?{PARAMETER}={self._access.token()}"

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
            # A list: viser makes numbers of the unknown values of a tuple.
            chart.data = [columns[0], *rows]
        if feed.flown != self._drawn:
            self._drawn = feed.flown
            scene.set_trail(*feed.trail())
        mission, route = self.steering.state.get("mission"), self.steering.route
        if not (mission and route):
            route = [point.position_m for point in self._experiment.mission.waypoints]
        scene.set_waypoints(np.array(route), len(mission["reached"]) if mission else 0)
        self._status.content = self._describe(now)
        if controls := self._controls:
            controls.update(now)

    def show_picture(self, image: Image) -> None:
        """Show a picture of the robot's camera, above the charts."""
        if self._picture is not None:
            self._picture.image = image
            return
        with self._charts_tab:
            self._picture = self._server.gui.add_image(
                image, label="camera, as cloud has it", format="jpeg", order=-1
            )

    def close(self) -> None:
        """Stop serving the page."""
        self._door.stop()
        self._server.stop()

    def _add_panels(self, *, with_legend: bool) -> None:
        gui = self._server.gui
        gui.configure_theme(show_share_button=False, show_logo=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(PANEL_WIDTH)
        gui.add_html(BELOW_STOP, order=-1)
        self._status = gui.add_markdown("waiting for the robot", order=2)
        if with_legend:
            gui.add_html(LEGEND, order=2.5)
        panel = gui.add_panel()
        self._charts_tab = panel.add_tab("Charts")
        with self._charts_tab:
            self._charts = [_add_chart(gui, title) for title in CHARTS]
        panel.dock_left()
        panel.set_width(PANEL_WIDTH)

    def _describe(self, now: float) -> str:
        """Return mission, guard and the newest answer, as Markdown."""
        state, answer = self.steering.state, self.steering.answer
        robot = describe_robot(state.get("seen"), state.get("cloud_age_s"))
        lines = [self._describe_mission(now), *robot]
        if now - answer.at < ANSWER_SHOWN:
            lines.insert(0, f"**{answer.words}**")
        return "  \n".join(lines).replace("cloudrc mission ", "")  # buttons have the verbs' names

    def _describe_mission(self, now: float) -> str:
        mission = self.steering.state.get("mission")
        is_free = not mission or mission["by_hand"] or mission["state"] == "held"
        if is_free and self.steering.velocity(now) != ZERO:
            return "driving by hand"
        if is_drive(mission):
            return "driving by hand, waits for keys"
        return describe_mission(mission) if mission else "no mission"

    def describe(self) -> list[str]:
        """Return the lines of the state, without marks."""
        return self._describe(time.monotonic()).replace("**", "").split("  \n")

    def _welcome(self, client: viser.ClientHandle) -> None:
        """Give the controls to a new browser if no other browser has them."""
        with self._lock:
            is_pilot = self.pilot is None
            if is_pilot:
                self.pilot = client.client_id
        if is_pilot:
            files = self._experiment.world.files
            self._controls = Controls(client, self.acts, self.steering, self._feed, files)
        else:
            client.gui.add_markdown("**Read only**: another browser steers.", order=0)

    def _succeed(self, client: viser.ClientHandle) -> None:
        """Give the controls to another browser if the browser that had them has left."""
        with self._lock:
            if self.pilot != client.client_id:
                return
            self.pilot = self._controls = None
        for other in self._server.get_clients().values():
            other.gui.reset()
            self._welcome(other)


def _add_chart(gui: viser.GuiApi, title: str) -> Any:
    _, span, curves = CHARTS[title]
    lines: list[Any] = [
        {"label": name, "stroke": colour, "width": 1.5} for name, (_, colour) in curves.items()
    ]
    low = {"hard": 0, "soft": 0, "mode": 1, "pad": 0}
    high = {"soft": span, "mode": 1, "pad": 0.1}
    return gui.add_uplot(
        (np.zeros(1),) * (1 + len(curves)),
        ({"label": "s"}, *lines),
        title=title,
        scales={"x": {"time": False}, "y": {"range": {"min": low, "max": high}}},
        axes=({"size": 30}, {"size": 46}),
        legend={"show": len(curves) > 1, "live": False},
        padding=(10, 16, 0, 0),
        height=132,
    )


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
