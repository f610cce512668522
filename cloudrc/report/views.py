"""Make topics for viewers: Foxglove and Lichtblick show them without settings.

Each moving thing is a frame on `/tf`: `base_link` is the robot's true pose, `estimate` the pose
that cloud predicted, `setpoint` the position that the controller tracks. `/scene` has one message:
a marker for each body. A marker moves with its frame; the scene has the frame `world`.

`estimate` and `setpoint` have the stamps of `/estimated_odometry`. Each stamp is the time at which
cloud sent a command.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np

from cloudrc.config.load import ResolvedExperiment
from cloudrc.geometry.shapes import Shapes, Surface
from cloudrc.geometry.tubes import wall
from cloudrc.metrics import Flight
from cloudrc.metrics.control import prediction_errors, tracking_errors
from cloudrc.metrics.flight import Array, Columns, select
from cloudrc.record.columns import Recording
from cloudrc.record.content import Message
from cloudrc.record.ros import encode_view, header, part
from cloudrc.report.flown import flight_of, flown_shapes

_Colour: TypeAlias = tuple[float, float, float, float]
_Shape: TypeAlias = tuple[Any, ...]  # arguments of `_marker`, from `name` on

PERIOD_NS = 40_000_000
"""Time between two messages of a topic [ns]. Viewers interpolate poses. With a shorter period, the
views would enlarge the file by more than 15 %."""
SPHERE, LINE_STRIP, TRIANGLE_LIST = 2, 4, 11
"""Types of a ROS marker."""
LEVEL = (1.0, 0.0, 0.0, 0.0)
GOAL, PATH = (0.84, 0.37, 0.0, 0.9), (0.0, 0.45, 0.70, 1.0)
GHOST, GLASS = (0.34, 0.71, 0.91, 0.45), (0.70, 0.74, 0.78, 0.35)
"""Colours of setpoint, path, predicted robot and tubes: red, green, blue, opacity in [0, 1]."""
GOAL_SIZE = 0.12
"""Largest diameter of the setpoint's ball [m]; that of a small robot is smaller."""


def views(recording: Recording, experiment: ResolvedExperiment) -> list[Message]:
    """Convert a recording to messages that viewers such as Foxglove can show.

    Raises:
        BadInputError: If the scene of the experiment cannot be read.
    """
    flight, truth = flight_of(recording, experiment), recording["/ground_truth"]
    if not len(truth):
        return []
    poses, control = _thin({name: truth[name] for name in truth.names}), _thin(flight.control)
    first_ns = int(truth["stamp_ns"][0])
    bodies = flown_shapes(recording, experiment)
    shapes = _robot(bodies)
    size = min(GOAL_SIZE, bodies.size / 4) if bodies.robot else GOAL_SIZE
    shapes.append(("setpoint", SPHERE, "setpoint", size, GOAL))
    shapes += [_solid(tube.name, "world", [wall(tube, GLASS, 24)]) for tube in flight.scene.tubes]
    shapes += _obstacles(bodies, {tube.name for tube in flight.scene.tubes})
    if len(path := poses["position"]) > 1:
        shapes.append(("path", LINE_STRIP, "world", 0.02, PATH, path))
    markers = [_marker(number, first_ns, *shape) for number, shape in enumerate(shapes)]
    return [
        ("/scene", first_ns, encode_view("/scene", markers)),
        *_transforms(poses, base_link=("position", "orientation_wxyz")),
        *_transforms(control, estimate=("position", "orientation_wxyz"), setpoint=("setpoint", "")),
        *_errors("/tracking_error", *_tracking(flight)),
        *_errors("/prediction_error", *prediction_errors(flight)[1:]),
    ]


def _thin(columns: Columns) -> Columns:
    """Keep the first row of `columns` in each period of length `PERIOD_NS`."""
    return select(columns, np.flatnonzero(np.diff(columns["stamp_ns"] // PERIOD_NS, prepend=-1)))


def _transforms(columns: Columns, **frames: tuple[str, str]) -> Iterator[Message]:
    """Yield a /tf message with all `frames` for each row of `columns`.

    `frames`: frame -> names of its position column and of its orientation column. If the latter is
    "", the frame is level.
    """
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


def _tracking(flight: Flight) -> tuple[Array, Array]:
    """Return the stamps of all control periods [ns], and setpoint minus true position [m]."""
    stamps_ns = flight.control["stamp_ns"]
    return stamps_ns, tracking_errors(flight, flight.true_position(stamps_ns))


def _errors(topic: str, stamps_ns: Array, errors: Array) -> Iterator[Message]:
    """Yield messages of `topic`: the lengths of `errors` [m], shape (n, 3), at `stamps_ns` [ns].

    At most one message per PERIOD_NS.
    """
    thin = _thin({"stamp_ns": stamps_ns, "error": errors})
    sizes = np.linalg.norm(thin["error"], axis=1).astype(np.float32).tolist()
    for stamp_ns, size in zip(thin["stamp_ns"].tolist(), sizes, strict=True):
        yield topic, stamp_ns, encode_view(topic, size)


def _quaternion(wxyz: Iterable[float]) -> Any:
    w, x, y, z = wxyz
    return part("geometry_msgs/msg/Quaternion", x, y, z, w)


def _marker(
    number: int,
    stamp_ns: int,
    name: str,
    kind: int,
    frame: str,
    size: float,
    colour: _Colour,
    points: Iterable[Any] = (),
    colours: Iterable[_Colour] = (),
) -> Any:
    """Make a ROS marker at the origin of `frame`; `size` and `points`, shape (n, 3), in [m]."""
    point, none = "geometry_msgs/msg/Point", np.zeros(0, np.uint8)
    pose = part("geometry_msgs/msg/Pose", part(point, 0.0, 0.0, 0.0), _quaternion(LEVEL))
    forever = part("builtin_interfaces/msg/Duration", 0, 0)
    picture = part("sensor_msgs/msg/CompressedImage", header(0, ""), "", none)
    mesh = part("visualization_msgs/msg/MeshFile", "", none)
    about = header(stamp_ns, frame), name, number, kind, 0, pose
    look = part("geometry_msgs/msg/Vector3", *(size,) * 3), part("std_msgs/msg/ColorRGBA", *colour)
    corners = [part(point, *xyz) for xyz in np.asarray(points, np.float32).tolist()]
    paint = [part("std_msgs/msg/ColorRGBA", *each) for each in colours]
    return part(
        "visualization_msgs/msg/Marker",
        *(*about, *look, forever, True, corners, paint),
        *("", picture, [], "", "", mesh, False),  # no texture, text or mesh
    )


def _robot(bodies: Shapes) -> list[_Shape]:
    """Make the shapes of the robot, and of the robot that cloud predicts."""
    if not bodies.robot:
        return []
    ghost = [replace(surface, rgba=GHOST) for surface in bodies.robot]
    return [_solid("robot", "base_link", bodies.robot), _solid("estimate", "estimate", ghost)]


def _obstacles(bodies: Shapes, tubes: set[str]) -> list[_Shape]:
    """Make a shape for each body of the scene that is not a tube."""
    parts: defaultdict[str, list[Surface]] = defaultdict(list)
    for surface in bodies.scene:
        if surface.body not in tubes:
            parts[surface.body].append(surface)
    return [_solid(body, "world", surfaces) for body, surfaces in parts.items()]


def _solid(name: str, frame: str, surfaces: Sequence[Surface]) -> _Shape:
    """Make a shape of triangles; each triangle has the colour and opacity of its surface."""
    points = [surface.corners[surface.triangles].reshape(-1, 3) for surface in surfaces]
    colours = [
        surface.rgba
        for surface, corners in zip(surfaces, points, strict=True)
        for _ in range(len(corners))
    ]
    several = colours if len(set(colours)) > 1 else []
    return name, TRIANGLE_LIST, frame, 1.0, surfaces[0].rgba, np.concatenate(points), several
