# SPDX-License-Identifier: Apache-2.0

"""Draw the pictures on the pages of robots and missions: docs/robots/ and docs/missions/."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

import cloudrc
from cloudrc.config import shipped
from cloudrc.config.robot import find_robot
from cloudrc.flight.experiment import load
from tools.guests import DOCS, flight_of
from tools.pictures.stage import BLUE, GOAL, Array, Stage, View, check_size

SIZE = 720, 420
"""Width and height of a picture [pixels]."""
BYTES_MAX = 60_000
"""Largest size of a picture."""
QUALITY = 82
"""Of the lossy compression, 0 to 100."""
REACH = 0.42
"""Radius of a robot without a ball, the Pelican [m]."""
COPIES = 6
"""Number of robots in the picture of a mission."""
VIEWS = {
    "hover": View((0.2, 0.0, 0.6), 4.5, 120.0, -24.0),
    "pipes": View((4.0, -2.7, 0.3), 14.0, 120.0, -42.0),
    "pillars": View((4.0, -0.2, 0.3), 9.5, 115.0, -38.0),
    "empty": View((0.0, 0.0, 1.0), 4.8, 120.0, -24.0),
}
"""Mission, or scene -> view of a mission in it."""


def draw_robots() -> None:
    """Draw each shipped robot: in the air, or on the floor if it stays there."""
    for name in shipped.names("robot"):
        robot = find_robot(name)
        stage = Stage(name, "empty", SIZE, {"robot": None})
        radius = robot.hull_m or REACH
        height = 0.1 if robot.planar else 1.5 * radius
        stage.place("robot", (0.0, 0.0, height))
        view = View((0.0, 0.0, 0.8 * height), 4.2 * radius, 145.0, -24.0)
        write(stage.draw(view, np.zeros((0, 3)), ()), DOCS / "robots" / f"{name}.webp")


def draw_missions() -> None:
    """Draw each shipped mission."""
    for name in shipped.names("mission"):
        experiment, settings = flight_of("mission", name)
        view = VIEWS.get(name)
        write(_flown(experiment, settings, view), DOCS / "missions" / f"{name}.webp")


def _flown(name: str, settings: dict[str, str], view: View | None) -> Array:
    """Fly, and draw the path, the goals as balls, and the robot at some instants."""
    world = load(name, [f"{key}={value}" for key, value in settings.items()]).world
    flight = cloudrc.fly(name, settings).flight
    stage = Stage(world.robot, world.scene, SIZE, dict.fromkeys(map(str, range(COPIES))))
    view, truth = view or VIEWS[world.scene], flight.truth
    stage.open_pipes(view)
    rows = np.linspace(0, len(truth["position"]) - 1, COPIES).round().astype(int)
    for copy, row in enumerate(rows):
        stage.place(str(copy), truth["position"][row], truth["orientation_wxyz"][row])
    goals: Any = [each.position_m for each in flight.mission.waypoints]
    if flight.mission.steps:
        goals = np.unique(flight.control["setpoint"], axis=0)
    path = truth["position"][::15]
    balls = [(goal, 0.07, GOAL) for goal in goals]
    return stage.draw(view, path, [BLUE] * len(path), balls)


def write(picture: Array, target: Path) -> None:
    """Write a picture, shape (height, width, 3), as a WebP file below `BYTES_MAX`."""
    target.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(target, quality=QUALITY, method=6)
    check_size(target, BYTES_MAX)
