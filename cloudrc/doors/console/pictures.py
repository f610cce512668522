# SPDX-License-Identifier: Apache-2.0

"""Take the pictures that cloud has, and write their age into a corner."""

from __future__ import annotations

from io import BytesIO
from math import isfinite
from pathlib import Path

import numpy as np
import PIL.Image
from PIL import ImageDraw

from cloudrc.flight.pod.readers import RecordReader
from cloudrc.teleop.wire import RobotStatus
from cloudrc.wire.pictures import Image
from cloudrc.wire.records import FrameKept

AGAIN_NS = 100_000_000
"""Time between two pictures of the page, as far as telemetry shows it [ns]."""
AT, SIZE, EDGE = (4, 2), 14, 3
"""Corner of the text, its height, and the width of the border around it [points]."""
PAPER, INK = (0, 0, 0), (255, 255, 255)
"""Colours of border and text."""


class PictureFeed:
    """The newest picture that cloud has, from its records.

    Its age is that on world's clock: from the time at which it was taken to now, which is the
    newest telemetry's stamp plus its delay, where that is known.
    """

    def __init__(self, folder: Path) -> None:
        """Read the records of cloud; `folder` has their sockets."""
        self._reader = RecordReader(folder, (FrameKept,))
        self._newest: FrameKept | None = None
        self._shown_ns = 0

    def take(self, status: RobotStatus | None) -> Image | None:
        """Return the newest picture with its age at a `status` of the robot, now and then."""
        for record in self._reader.take(0.0):
            if isinstance(record, FrameKept):
                self._newest = record
        if status is None or self._newest is None:
            return None
        delay = status.uplink_delay if isfinite(status.uplink_delay) else 0.0
        now_ns = status.stamp_ns + round(delay * 1e9)
        if 0 <= now_ns - self._shown_ns < AGAIN_NS:
            return None
        self._shown_ns = now_ns
        return with_age(self._newest.data, (now_ns - self._newest.stamp_ns) * 1e-9)

    def close(self) -> None:
        """Stop to read."""
        self._reader.close()


def with_age(data: bytes, age: float) -> Image:
    """Return the picture in a file with its age [s] in the corner."""
    picture = PIL.Image.open(BytesIO(data)).convert("RGB")
    draw, text = ImageDraw.Draw(picture), f"{max(age, 0.0) * 1e3:.0f} ms"
    left, top, right, bottom = draw.textbbox(AT, text, font_size=SIZE)
    draw.rectangle((left - EDGE, top - EDGE, right + EDGE, bottom + EDGE), PAPER)
    draw.text(AT, text, INK, font_size=SIZE)
    return np.asarray(picture)
