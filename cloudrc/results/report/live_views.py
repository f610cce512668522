# SPDX-License-Identifier: Apache-2.0

"""Make the messages of a recording from cloud's records during a flight, for Foxglove's layout."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cloudrc.physics.geometry.shapes import Pose
from cloudrc.results.record.content import Message
from cloudrc.results.record.live import BASE, encode_transforms, frames_of
from cloudrc.results.record.ros import CAMERA, LIDAR, encode
from cloudrc.results.record.topics import TOPICS, topics_of
from cloudrc.results.report.markers import MarkerShape, encode_markers
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import (
    Control,
    FrameKept,
    GuardChange,
    Record,
    ScanTaken,
    TelemetrySent,
)

REPEAT_NS = 1_000_000_000
"""Time after which /scene and /guard come again [ns]: a viewer that comes later needs them, too."""


class LiveViews:
    """Converts cloud's records to messages.

    Of the robot, cloud knows what telemetry says: the frame `base_link` is its measured pose.
    """

    def __init__(
        self,
        shapes: Sequence[MarkerShape],
        scanner: Pose | None = None,
        camera: Pose | None = None,
    ) -> None:
        """Set the bodies of /scene, and the poses of the sensors in the frame of the base."""
        self._shapes = shapes
        self._sensors = {ScanTaken: (LIDAR, scanner), FrameKept: (CAMERA, camera)}
        self._guard: GuardState | None = None
        self._repeated_ns = -REPEAT_NS

    def of(self, record: Record) -> Iterator[Message]:
        """Yield the messages of a record."""
        for topic in topics_of(record):
            row = topic.row(record)
            yield topic.name, row[0], encode(topic, row)
        if isinstance(record, TelemetrySent):
            yield from self._of_telemetry(record)
        elif isinstance(record, ScanTaken | FrameKept):
            frame, pose = self._sensors[type(record)]
            stamp_ns = record.stamp_ns
            if pose is not None:
                yield "/tf", stamp_ns, encode_transforms(stamp_ns, {frame: pose}, BASE)
        elif isinstance(record, Control):
            yield "/tf", record.stamp_ns, encode_transforms(record.stamp_ns, frames_of(record))

    def _of_telemetry(self, record: TelemetrySent) -> Iterator[Message]:
        telemetry, stamp_ns = record.telemetry, record.stamp_ns
        pose = telemetry.odometry.position, telemetry.odometry.orientation_wxyz
        yield "/tf", stamp_ns, encode_transforms(stamp_ns, {BASE: pose})
        repeats = stamp_ns - self._repeated_ns >= REPEAT_NS
        if repeats or telemetry.guard is not self._guard:
            self._guard = telemetry.guard
            guard, change = TOPICS["/guard"], GuardChange(stamp_ns, self._guard, "")
            yield guard.name, stamp_ns, encode(guard, guard.row(change))
        if repeats:
            self._repeated_ns = stamp_ns
            yield "/scene", stamp_ns, encode_markers(stamp_ns, self._shapes)
