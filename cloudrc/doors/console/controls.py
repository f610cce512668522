# SPDX-License-Identifier: Apache-2.0

"""The controls of the browser that steers: buttons, the target, keys, sliders of the link.

viser reports the release of a button, but not the release of a key. Therefore, while the user holds
a key, a script of the page (`console/web/scene.js`) holds the button of the same direction.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from math import inf
from typing import Any

import numpy as np
import viser

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.world import WorldFiles
from cloudrc.doors.console.feed import FlightFeed
from cloudrc.doors.console.steering import SLIDERS, Reply, Steering
from cloudrc.physics.geometry.obstacles import fence_of
from cloudrc.wire.messages import Vector

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
TOUCHED = 2.0
"""Time after a move of a slider for which no slider follows the link [s]."""


def acts_of(experiment: ResolvedExperiment, steering: Steering) -> dict[str, Callable[[], Reply]]:
    """Return the name of each button of a mission, and what it does."""

    def start() -> Reply:
        mission = experiment.mission
        if mission.steps is not None:
            text = "start: random steps are for 'cloudrc run'; send waypoints instead"
            return steering.say(text, is_refusal=True)
        order = mission.model_dump(mode="json", exclude={"steps"}, exclude_none=True)
        return steering.start_mission({**order, "name": experiment.name})

    verbs = "hold", "resume", "cancel", "acknowledge"
    return {"start": start, **{verb: partial(steering.act, verb) for verb in verbs}}


class Controls:
    """The controls of one browser."""

    def __init__(
        self,
        client: viser.ClientHandle,
        acts: dict[str, Callable[[], Reply]],
        steering: Steering,
        feed: FlightFeed,
        files: WorldFiles,
    ) -> None:
        """Add the controls to the panel and the scene of a browser.

        `acts` are those of `acts_of`; `files` are robot and scene.
        """
        self._steering, self._feed, self._is_planar = steering, feed, files.robot.planar
        scene = files.scene
        fence, self._spawn = fence_of(scene), scene.spawn
        self._limits: tuple[Vector, Vector] = fence.inner_low, fence.inner_high  # corners [m]
        if self._is_planar:
            ground = self._spawn[2]
            self._limits = (*fence.inner_low[:2], ground), (*fence.inner_high[:2], ground)
        self._touched = -inf  # when somebody last moved a slider [s]
        self._is_moved = False  # whether somebody has moved the target, and has not sent it
        gui = client.gui
        tabs = gui.add_tab_group(order=3)
        with tabs.add_tab("Steer"):
            self._add_mission(gui, acts)
            self._gizmo, self._numbers = self._add_target(client)
            self._add_keys(gui)
        with tabs.add_tab("Link"):
            self._sliders = self._add_link(gui)

    def update(self, now: float) -> None:
        """Show the present link and target at `now` [s], unless somebody moves them."""
        with suppress(RuntimeError):  # viser has just removed the controls of a browser that left
            if now - self._touched >= TOUCHED:
                self._follow_link()
            if not self._is_moved:
                self._gizmo.position = place = self._target(now)
                self._numbers.value = self._shown(place)

    def _target(self, now: float) -> Vector:
        """Return the position [m] at `now` [s] of a target that no user has moved.

        It is the setpoint if cloud controls the robot, else the point 0.6 m above the robot, or the
        robot's own place on the ground.
        """
        status = self._feed.status
        if (control := self._feed.control(now)) is not None:
            at: Any = control.setpoint
        else:
            above = (0, 0, 0 if self._is_planar else 0.6)
            at = np.add(status.position if status else self._spawn, above)
        x, y, z = map(float, np.round(np.clip(at, *self._limits), 2))
        return x, y, z

    def _shown(self, place: Any) -> Any:
        """Return a place [m] as the number fields show it: without a height on the ground."""
        return tuple(map(float, place[:2] if self._is_planar else place))

    def _follow_link(self) -> None:
        for key, slider in self._sliders.items():
            value = self._steering.conditions.get(key)
            if value is not None:
                shown = min(value * SLIDERS[key.partition(".")[2]][-1], slider.max)
                if abs(slider.value - shown) > 1e-6:
                    slider.value = shown

    def _add_mission(self, gui: viser.GuiApi, acts: dict[str, Callable[[], Reply]]) -> None:
        names = [name.title() for name in acts]
        for label, some in (("Mission", names[:3]), (" ", names[3:])):
            group = gui.add_button_group(label, some)

            @group.on_click
            def _(event: Any) -> None:
                acts[event.target.value.lower()]()

    def _add_target(self, client: viser.ClientHandle) -> tuple[Any, Any]:
        """Add a gizmo and number fields for the target position; a change of one updates both."""
        gui, start = client.gui, self._target(time.monotonic())
        gizmo = client.scene.add_transform_controls(
            "/target",
            scale=0.45,
            disable_rotations=True,
            active_axes=(True, True, not self._is_planar),
            translation_limits=tuple(zip(*self._limits, strict=True)),  # type: ignore[arg-type]
            depth_test=False,
            position=start,
        )
        add: Any = gui.add_vector2 if self._is_planar else gui.add_vector3
        numbers = add("Target [m]", self._shown(start), step=0.01)
        send = gui.add_button("Send", hint="Go to the target; a mission is held first")

        # viser awaits a coroutine where the value arrives, so that neither `update` nor a click on
        # Send comes between; a function would wait for a free thread.
        @gizmo.on_update
        async def _(event: Any) -> None:
            if event.client is not None:  # somebody drags
                self._is_moved = True
                numbers.value = self._shown(np.round(gizmo.position, 2))

        async def move(event: Any) -> None:
            if event.client is not None:  # somebody has typed
                self._is_moved = True
                gizmo.position = (*numbers.value, gizmo.position[2])[:3]

        numbers.on_update(move)

        @send.on_click
        def _(_: object) -> None:
            self._is_moved = self._steering.go_to(numbers.value).is_refusal

        return gizmo, numbers

    def _add_keys(self, gui: viser.GuiApi) -> None:
        """Add the buttons for driving by hand; a held button repeats its key at 10 Hz."""
        steering = self._steering
        speed = gui.add_slider("Drive [m/s]", 0.1, 1.0, 0.1, 0.4)
        for code, (label, direction) in KEYS.items():
            if self._is_planar and direction[2]:
                continue  # the key has no button, so it does nothing
            button = gui.add_button(label, color="gray")

            @button.on_hold
            async def _(_: object, code: str = code, direction: Vector = direction) -> None:
                x, y, z = (part * _clamp(speed) for part in direction)
                steering.hold_key(code, (x, y, z), RELEASED)

            @button.on_click
            async def _(_: object, code: str = code) -> None:
                steering.release_keys(code)

    def _add_link(self, gui: viser.GuiApi) -> dict[str, Any]:
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

        return sliders


def _clamp(slider: Any) -> float:
    """Limit the value of a slider, whose number field accepts any number; return the value."""
    value = float(np.clip(slider.value, slider.min, slider.max))
    if value != slider.value:
        slider.value = value
    return value
