"""Make topics for viewers: Foxglove and Lichtblick show them without settings.

Each moving thing is a frame on `/tf`: `base_link` is the true robot, `estimate` the robot as cloud
predicted it, `setpoint` the position that the controller tracks. `/scene` has one message: a marker
for each shape. A marker moves with its frame; the pipes have the frame `world`.

The stamps of `estimate` and `setpoint` are those of `/estimated_odometry`: when cloud sent the
command.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, TypeAlias

import numpy as np

from cloudrc.config.load import ResolvedExperiment
from cloudrc.geometry import clearance as body
from cloudrc.geometry.scene import Board, Pipe, load_scene
from cloudrc.metrics import Flight
from cloudrc.metrics.flight import Columns
from cloudrc.record.columns import Recording
from cloudrc.record.reader import Contents
from cloudrc.record.ros import encode_view, header, part

View: TypeAlias = tuple[str, int, bytes]
"""Topic, log time [ns] on world's clock, CDR bytes of a message."""
_Colour: TypeAlias = tuple[float, float, float, float]
_Shape: TypeAlias = tuple[Any, ...]  # arguments of `_marker`, from `name` on

PERIOD_NS = 40_000_000
"""Time between two messages of a topic [ns]. Viewers interpolate poses. With a shorter period, the
views would enlarge the file by more than 15 %."""
CUBE, SPHERE, CYLINDER, LINE_STRIP, TRIANGLE_LIST = 1, 2, 3, 4, 11
"""Types of a ROS marker."""
ORIGIN, LEVEL = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
BASE, ROD, ARM = (0.16, 0.33, 0.55, 1.0), (0.30, 0.30, 0.32, 1.0), (0.84, 0.37, 0.0, 1.0)
ROTOR, BOARD, PIPE = (0.5, 0.5, 0.55, 0.6), (0.95, 0.84, 0.58, 1.0), (0.70, 0.74, 0.78, 0.35)
PATH, GOAL, GHOST = (0.0, 0.45, 0.70, 1.0), (0.84, 0.37, 0.0, 0.9), (0.34, 0.71, 0.91, 0.45)
"""Colours of the markers: red, green, blue, opacity in [0, 1]."""


def add_views(mission: Contents, experiment: ResolvedExperiment) -> Recording:
    """Replace the views of a mission; return the mission's tables. Errors are those of `views`."""
    recording = mission.recording()
    mission.views = views(recording, experiment)
    return recording


def views(recording: Recording, experiment: ResolvedExperiment) -> list[View]:
    """Make all messages for viewers.

    Raises:
        BadInputError: If the scene of the experiment cannot be read.
    """
    scene, truth = load_scene(experiment.world.scene), recording["/ground_truth"]
    if not len(truth):
        return []
    flight = Flight(recording, experiment.criteria, experiment.mission, scene)
    poses, control = _thin({name: truth[name] for name in truth.names}), _thin(flight.control)
    first_ns = int(truth["stamp_ns"][0])
    shapes = [*_robot("robot", "base_link"), *_robot("estimate", "estimate", GHOST)]
    shapes += [("setpoint", SPHERE, "setpoint", ORIGIN, (0.12,) * 3, GOAL)]
    shapes += [_pipe(pipe) for pipe in scene.pipes]
    shapes += [_board(scene.board)] if scene.board else []
    if len(path := poses["position"]) > 1:
        shapes.append(("path", LINE_STRIP, "world", ORIGIN, (0.02,) * 3, PATH, path))
    markers = [_marker(number, first_ns, *shape) for number, shape in enumerate(shapes)]
    return [
        ("/scene", first_ns, encode_view("/scene", markers)),
        *_transforms(poses, base_link=("position", "orientation_wxyz")),
        *_transforms(control, estimate=("position", "orientation_wxyz"), setpoint=("setpoint", "")),
        *_errors("/tracking_error", flight, flight.control, "setpoint"),
        *_errors("/prediction_error", flight, flight.applied, "position"),
    ]


def _thin(columns: Columns) -> Columns:
    """Keep the first row of each `PERIOD_NS`."""
    rows = np.flatnonzero(np.diff(columns["stamp_ns"] // PERIOD_NS, prepend=-1))
    return {name: column[rows] for name, column in columns.items()}


def _transforms(columns: Columns, **frames: tuple[str, str]) -> Iterator[View]:
    """Yield a message per row. `frames`: frame -> names of the position and orientation column."""
    for row, stamp_ns in enumerate(columns["stamp_ns"].tolist()):
        parts = [
            part(
                "geometry_msgs/msg/TransformStamped",
                header(stamp_ns),
                frame,
                part(
                    "geometry_msgs/msg/Transform",
                    part("geometry_msgs/msg/Vector3", *columns[place][row].tolist()),
                    _quaternion(columns[turn][row].tolist() if turn else LEVEL),
                ),
            )
            for frame, (place, turn) in frames.items()
        ]
        yield "/tf", stamp_ns, encode_view("/tf", parts)


def _errors(topic: str, flight: Flight, columns: Columns, name: str) -> Iterator[View]:
    """Yield, per row, the distance [m] from the position in column `name` to the true position."""
    columns = _thin(columns)
    away = columns[name] - flight.true_position(columns["stamp_ns"])
    errors = np.linalg.norm(away, axis=1).astype(np.float32).tolist()
    for stamp_ns, error in zip(columns["stamp_ns"].tolist(), errors, strict=True):
        yield topic, stamp_ns, encode_view(topic, error)


def _quaternion(wxyz: Iterable[float]) -> Any:
    w, x, y, z = wxyz
    return part("geometry_msgs/msg/Quaternion", x, y, z, w)


def _marker(
    number: int,
    stamp_ns: int,
    name: str,
    kind: int,
    frame: str,
    position: Iterable[float],
    scale: Iterable[float],
    colour: _Colour,
    points: Any = (),
) -> Any:
    """Make a marker; lengths in [m], `points` have shape (n, 3)."""
    point, colour_of = "geometry_msgs/msg/Point", part("std_msgs/msg/ColorRGBA", *colour)
    none = np.zeros(0, np.uint8)
    pose = part("geometry_msgs/msg/Pose", part(point, *position), _quaternion(LEVEL))
    forever = part("builtin_interfaces/msg/Duration", 0, 0)
    corners = [part(point, *xyz) for xyz in np.asarray(points, np.float32).tolist()]
    picture = part("sensor_msgs/msg/CompressedImage", header(0, ""), "", none)
    mesh = part("visualization_msgs/msg/MeshFile", "", none)
    return part(
        "visualization_msgs/msg/Marker",
        *(
            header(stamp_ns, frame),
            name,
            number,
            kind,
            0,
            pose,
            part("geometry_msgs/msg/Vector3", *scale),
            colour_of,
            forever,
            True,
        ),
        *(corners, [], "", picture, [], "", "", mesh, False),
    )


def _robot(name: str, frame: str, colour: _Colour | None = None) -> Iterator[_Shape]:
    """Build the robot from simple shapes, in `colour`, or else in the colours of its parts."""
    width, rod = 2 * body.ROD_RADIUS, body.ROD_TOP - body.ROD_BOTTOM
    arm, thin, span = body.ARM_LENGTH, 2 * body.ARM_RADIUS, 2 * body.ROTOR_ARM
    disc = (2 * body.ROTOR_RADIUS, 2 * body.ROTOR_RADIUS, 2 * body.ROTOR_HALF_THICKNESS)
    parts = [
        (CUBE, ORIGIN, [2 * half for half in body.BASE_HALF], BASE),
        (CYLINDER, (0.0, 0.0, body.ROD_BOTTOM + rod / 2), (width, width, rod), ROD),
        (CUBE, (arm / 2, 0.0, body.ARM_HEIGHT), (arm, thin, thin), ARM),
        # The simulated robot has no struts; they connect the rotors to the base.
        (CUBE, (0.0, 0.0, body.ROTOR_HEIGHT), (span, 0.012, 0.012), ROD),
        (CUBE, (0.0, 0.0, body.ROTOR_HEIGHT), (0.012, span, 0.012), ROD),
    ]
    for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1)):
        hub = (x * body.ROTOR_ARM, y * body.ROTOR_ARM, body.ROTOR_HEIGHT)
        parts.append((CYLINDER, hub, disc, ROTOR))
    for kind, position, scale, own in parts:
        yield name, kind, frame, position, scale, colour or own


def _pipe(pipe: Pipe) -> _Shape:
    """Build the inner face of a pipe, open at both ends, from 32 flat strips."""
    axis = np.array(pipe.axis)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    angle = np.linspace(0.0, 2 * np.pi, 33)[:, None]
    ring = pipe.inner * (np.cos(angle) * across + np.sin(angle) * np.cross(axis, across))
    low, high = (ring + pipe.centre + end * pipe.length / 2 * axis for end in (-1, 1))
    corners = np.stack([low[:-1], high[:-1], high[1:], low[:-1], high[1:], low[1:]], axis=1)
    points = corners.reshape(-1, 3)
    return pipe.name, TRIANGLE_LIST, "world", ORIGIN, (1.0,) * 3, PIPE, points


def _board(board: Board) -> _Shape:
    (left, right), (low, high) = board.y, board.z
    middle = (board.x + 0.025, (left + right) / 2, (low + high) / 2)
    return "board", CUBE, "world", middle, (0.05, right - left, high - low), BOARD
