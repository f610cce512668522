# SPDX-License-Identifier: Apache-2.0

"""The robot's camera in robot.yaml, and how its pictures travel in an experiment."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from cloudrc.base.outside.values import Quantity
from cloudrc.config.section import Section

QUALITY = Quantity(ge=1, le=95, whole=True)
"""Quality of JPEG, as Pillow counts it."""
KBIT = Quantity("kbit/s", 10, 100_000, whole=True)
"""Bit rate of H.264."""


class CameraConfig(Section):
    """A camera, whose pictures go to cloud."""

    name: Annotated[str, Field(min_length=1)]
    """Name of a camera of the model"""
    width: Annotated[int, Field(ge=16, le=1920, multiple_of=2)] = 320
    """Columns of a picture, an even number"""
    height: Annotated[int, Field(ge=16, le=1080, multiple_of=2)] = 240
    """Rows of a picture, an even number"""
    fovy_deg: Annotated[float, Field(gt=0, lt=180)] = 45.0
    """Angle from the lowest to the highest row [deg], fovy of the model's camera: cloud has no
    model"""
    fps: Annotated[int, Field(ge=1, le=100)] = 15
    """Number of pictures per second [Hz]"""


class CodecConfig(Section):
    """How the pictures of the robot's camera travel to cloud."""

    codec: Literal["jpeg", "h264"] = "jpeg"
    """jpeg: each picture stands alone; h264: most hold what differs from the one before, so that
    after a loss cloud waits for the next key frame. h264 needs the extra `camera`"""
    quality: Annotated[int, QUALITY] = 70
    """Quality of JPEG, as Pillow counts it"""
    kbit: Annotated[int, KBIT] = 800
    """Mean and largest bit rate of H.264 [kbit/s]"""
    key_every_s: Annotated[float, Field(ge=0.01, le=60)] = 1.0
    """Time between two key frames of H.264 [s]"""
    keep: bool = False
    """Whether the recording holds the pictures that cloud had"""


OF_CODEC = {"jpeg": ("quality",), "h264": ("kbit", "key_every_s")}
"""Codec -> the keys of `CodecConfig` that only it has."""
