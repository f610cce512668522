# SPDX-License-Identifier: Apache-2.0

"""Make the replay of a flight: the 3-D scene over time, as HTML that loads nothing from a network.

The report contains the replay as a section; `cloudrc replay` writes it as a page of its own.
"""

from __future__ import annotations

import json
from html import escape
from importlib.resources import files
from string import Template

import numpy as np
import rich
import viser

from cloudrc.base.errors import NothingFlownError
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.results.metrics.flight import Flight
from cloudrc.results.metrics.mission import reported
from cloudrc.results.report.flown import flown_shapes
from cloudrc.results.report.scene import FlightScene

RATE = 25.0
"""Number of frames per second of flight time."""
FRAMES_MAX = 7_500
"""Largest number of frames; a flight longer than 5 min has fewer frames per second."""
STALE = 0.5
"""Age from which the replay hides a prediction [s]."""


def write_section(flight: Flight, experiment: ResolvedExperiment) -> str:
    """Return the replay of a flight as a section of an HTML page."""
    if not len(flight.truth["stamp_ns"]):
        raise NothingFlownError("the robot never flew, so there is no replay")
    rich.get_console().quiet = True  # else viser prints its address
    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        player = _record(server, flight, experiment)
    finally:
        server.stop()
    # Hide the warning about drawing without a graphics card: it would cover the scene.
    style = "<style>.mantine-Notifications-root { display: none }</style></head>"
    player = player.replace("</head>", style, 1)
    return Template(files(__package__).joinpath("replay.html").read_text("utf-8")).substitute(
        duration=max(flight.duration, 1e-3), player=json.dumps(player).replace("<", "\\u003c")
    )


def write_page(flight: Flight, experiment: ResolvedExperiment) -> str:
    """Return the replay as a complete HTML page; raise the same errors as `write_section`."""
    return (
        '<!DOCTYPE html>\n<html lang="en"><meta charset="utf-8">\n'
        f"<title>{escape(experiment.name)}: replay</title>\n"
        "<style>body { margin: 0; font: 1rem system-ui, sans-serif } h2, p { margin: .5rem 1rem }"
        " #replay .room { height: calc(100vh - 6rem) }</style>\n"
        f"<body>\n{write_section(flight, experiment)}</body></html>\n"
    )


def _record(server: viser.ViserServer, flight: Flight, experiment: ResolvedExperiment) -> str:
    """Record the flight in the scene of a server; return viser's page with the player."""
    shapes = flown_shapes(flight.recording, experiment)
    scene = FlightScene(server, experiment, shapes, flight.scene)
    duration = max(flight.duration, 1e-3)
    truth, control, applied = flight.truth, flight.control, flight.applied
    times = np.linspace(0.0, duration, int(min(duration * RATE, FRAMES_MAX)) + 1)
    true, asked, predicted = (
        np.searchsorted(flight.seconds(np.sort(table["stamp_ns"])), times, "right") - 1
        for table in (truth, control, applied)
    )
    true = np.maximum(true, 0)
    reached = np.searchsorted(flight.seconds(np.sort([*reported(flight).values()])), times, "right")
    points = np.array([waypoint.position_m for waypoint in flight.mission.waypoints])
    near = flight.clearance
    if not len(near):
        near = np.full(len(truth["stamp_ns"]), np.inf)
    scene.set_trail(truth["position"][true], near[true])
    recorded = server.get_scene_serializer()
    for frame, (row, now) in enumerate(zip(true, times, strict=True)):
        if frame:
            recorded.insert_sleep(float(times[1]))
        scene.move("robot", truth["position"][row], truth["orientation_wxyz"][row])
        ghost = predicted[frame]
        fresh = ghost >= 0 and now - flight.seconds(applied["stamp_ns"][ghost]) < STALE
        pose = applied["position"], applied["orientation_wxyz"]
        scene.move("ghost", *(column[ghost] if fresh else None for column in pose))
        for each in flight.scene.moving:
            scene.move(each.name, each.at(float(now)))
        scene.move("setpoint", control["setpoint"][asked[frame]] if asked[frame] >= 0 else None)
        if not frame or reached[frame] != reached[frame - 1]:
            scene.set_waypoints(points, int(reached[frame]))
    return recorded.as_html()
