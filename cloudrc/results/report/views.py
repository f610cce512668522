# SPDX-License-Identifier: Apache-2.0

"""Make topics for viewers: Foxglove and Lichtblick show them without settings.

Each moving thing is a frame on `/tf`: `base_link` is the robot's true pose, `estimate` the pose
that cloud predicted, `setpoint` the position that the controller tracks, `lidar` the scanner, where
`/scan` was measured, `camera` the camera (x to the right, z ahead). `/scene` has one message: a
marker for each body. A marker moves with its frame; the scene has the frame `world`, and a body of
it that moves its own.

`estimate` and `setpoint` have the stamps of `/estimated_odometry`. Each stamp is the time at which
cloud sent a command.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.results.metrics.control import prediction_errors, tracking_errors
from cloudrc.results.metrics.flight import Array, Columns, select
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.content import Message
from cloudrc.results.record.live import BASE, encode_transforms
from cloudrc.results.record.ros import CAMERA, LIDAR, pack
from cloudrc.results.record.topics import VIEWS
from cloudrc.results.report.flown import flight_of, flown_shapes
from cloudrc.results.report.markers import encode_markers, path_shape, scene_shapes

PERIOD_NS = 40_000_000
"""Time between two messages of a topic [ns]. Viewers interpolate poses. With a shorter period, the
views would enlarge the file by more than 15 %."""
LEVEL = (1.0, 0.0, 0.0, 0.0)


def views(recording: Recording, experiment: ResolvedExperiment) -> list[Message]:
    """Convert a recording to messages that viewers such as Foxglove can show."""
    flight, truth = flight_of(recording, experiment), recording["/ground_truth"]
    if not len(truth):
        return []
    poses, control = _thin(truth.columns), _thin(flight.control)
    first_ns = int(truth["stamp_ns"][0])
    bodies, shown = flown_shapes(recording, experiment), list[Message]()
    shapes = scene_shapes(bodies, flight.scene)
    if len(path := poses["position"]) > 1:
        shapes.append(path_shape("path", path))
    target = _thin(recording["/target"].columns)
    for body in flight.scene.moving:
        shown += _transforms(target, **{body.name: ("position", "")})
    for topic, frame, pose in (
        ("/scan", LIDAR, bodies.scanner),
        ("/camera", CAMERA, bodies.camera),
    ):
        if pose is not None:
            for stamp_ns in recording[topic]["stamp_ns"].tolist():
                shown.append(("/tf", stamp_ns, encode_transforms(stamp_ns, {frame: pose}, BASE)))
    stamps_ns = flight.control["stamp_ns"]
    tracking = tracking_errors(flight, flight.true_position(stamps_ns))
    return [
        ("/scene", first_ns, encode_markers(first_ns, shapes)),
        *_transforms(poses, base_link=("position", "orientation_wxyz")),
        *_transforms(control, estimate=("position", "orientation_wxyz"), setpoint=("setpoint", "")),
        *_errors("/tracking_error", stamps_ns, tracking),
        *_errors("/prediction_error", *prediction_errors(flight)[1:]),
        *shown,
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
        poses = {
            frame: (columns[place][row].tolist(), columns[turn][row].tolist() if turn else LEVEL)
            for frame, (place, turn) in frames.items()
        }
        yield "/tf", stamp_ns, encode_transforms(stamp_ns, poses)


def _errors(topic: str, stamps_ns: Array, errors: Array) -> Iterator[Message]:
    """Yield messages of `topic`: the lengths of `errors` [m], shape (n, 3), at `stamps_ns` [ns].

    At most one message per PERIOD_NS.
    """
    thin = _thin({"stamp_ns": stamps_ns, "error": errors})
    sizes = np.linalg.norm(thin["error"], axis=1).astype(np.float32).tolist()
    for stamp_ns, size in zip(thin["stamp_ns"].tolist(), sizes, strict=True):
        yield topic, stamp_ns, pack(VIEWS[topic], size)
