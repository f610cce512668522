# SPDX-License-Identifier: Apache-2.0

"""Encode pictures for their way to cloud, and decode them: JPEG with Pillow, H.264 with PyAV."""

from __future__ import annotations

import io
from collections.abc import Iterator
from fractions import Fraction
from math import nan
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.wire.messages import FRAGMENT_MAX, Fragment

if TYPE_CHECKING:
    from cloudrc.config.camera import CodecConfig

Image: TypeAlias = NDArray[np.uint8]
"""A picture: red, green, blue, shape (height, width, 3)."""
LACKS = "{} needs {} (not installed); run: pip install 'cloudrc[camera]'"


class EncodedFrame(NamedTuple):
    """A picture as it travels; its encoder knows only the data, and whether it is a key frame."""

    data: bytes
    key: bool  # whether it can be decoded without those before it
    stamp_ns: int = 0  # time at which it was taken [ns], world's clock
    number: int = 0  # in its session
    psnr: float = nan  # of what a receiver decodes [dB]
    encode_ns: int = 0  # time that rendering and encoding took [ns]

    def fragments(self) -> Iterator[Fragment]:
        """Cut the data."""
        cuts = range(0, len(self.data), FRAGMENT_MAX)
        for place, at in enumerate(cuts):
            part = self.data[at : at + FRAGMENT_MAX]
            yield Fragment(self.stamp_ns, self.number, place, len(cuts), self.key, part)


class Encoder(Protocol):
    """Encodes the pictures of a session, one after the other."""

    def encode(self, image: Image) -> EncodedFrame:
        """Encode the next picture."""


class Decoder(Protocol):
    """Decodes pictures of a session, one after the other, beginning with a key frame."""

    def decode(self, data: bytes) -> Image | None:
        """Decode a picture; None if the data do not make one."""


class Jpeg:
    """Encodes and decodes pictures that stand alone."""

    def __init__(self, quality: int = 70) -> None:
        """Set the quality, as Pillow counts it."""
        self._quality = quality
        _pillow()  # a lack is told here; an attribute of a module could not be copied

    def encode(self, image: Image) -> EncodedFrame:
        """Encode a picture."""
        return EncodedFrame(_written(_pillow(), image, "JPEG", quality=self._quality), True)

    def decode(self, data: bytes) -> Image | None:
        """Decode a picture."""
        try:
            return np.asarray(_pillow().open(io.BytesIO(data)).convert("RGB"))
        except (OSError, SyntaxError):
            return None


class H264Encoder:
    """Encodes pictures with x264, without a delay; all but the key frames need the one before."""

    def __init__(self, codec: CodecConfig, width: int, height: int, rate_hz: float) -> None:
        """Set bit rate and key frames of `codec`, size [pixels] and `rate_hz` of pictures [Hz]."""
        self._av, rate = _av(), f"{codec.kbit}k"
        self._context = made = self._av.CodecContext.create("libx264", "w")
        made.width, made.height, made.pix_fmt = width, height, "yuv420p"
        made.framerate = Fraction(rate_hz).limit_denominator(1000)
        made.time_base = 1 / made.framerate
        made.thread_count = 1  # with more, bytes would differ between machines
        made.options = {
            **{"preset": "veryfast", "tune": "zerolatency", "sc_threshold": "0"},
            "g": str(max(1, round(codec.key_every_s * rate_hz))),
            **{"b": rate, "maxrate": rate, "bufsize": f"{max(1, codec.kbit // 4)}k"},
        }
        self._count = 0

    def encode(self, image: Image) -> EncodedFrame:
        """Encode the next picture."""
        frame = self._av.VideoFrame.from_ndarray(image, format="rgb24")
        frame.pts, self._count = self._count, self._count + 1
        packets = self._context.encode(frame)
        key = any(packet.is_keyframe for packet in packets)
        return EncodedFrame(b"".join(map(bytes, packets)), key)


class H264Decoder:
    """Decodes what `H264Encoder` has encoded."""

    def __init__(self) -> None:
        """Begin before a key frame."""
        self._av = _av()
        self._context = self._av.CodecContext.create("h264", "r")
        self._context.thread_count = 1  # several would hold pictures back

    def decode(self, data: bytes) -> Image | None:
        """Decode the next picture."""
        try:
            frames = self._context.decode(self._av.Packet(data))
        except self._av.FFmpegError:
            return None
        image: Image | None = frames[-1].to_ndarray(format="rgb24") if frames else None
        return image


def make_encoder(codec: CodecConfig, width: int, height: int, rate_hz: float) -> Encoder:
    """Make the encoder of a session, with pictures of one size [pixels] at `rate_hz` [Hz].

    Raises:
        MissingPrerequisiteError: If its package is not installed.
    """
    if codec.codec == "jpeg":
        return Jpeg(codec.quality)
    return H264Encoder(codec, width, height, rate_hz)


def make_decoder(codec: str) -> Decoder:
    """Make the decoder of a session; raises as `make_encoder` does."""
    return Jpeg() if codec == "jpeg" else H264Decoder()


def as_png(image: Image) -> bytes:
    """Return a picture as a PNG file, without any loss."""
    return _written(_pillow(), image, "PNG", compress_level=1)


def psnr(image: Image, other: Image) -> float:
    """Return the peak signal-to-noise ratio of two pictures [dB]; 100 if they are nearly equal."""
    error = float(np.mean(np.square(image.astype(np.float32) - other)))
    return float(10.0 * np.log10(255.0**2 / max(error, 255.0**2 * 1e-10)))


def describe_codec(codec: str) -> str:
    """Return the name and version of the library that encodes."""
    if codec == "jpeg":
        return f"JPEG of Pillow {_pillow().__version__}"
    return f"x264 of PyAV {_av().__version__}"


def _written(pillow: Any, image: Image, kind: str, **options: int) -> bytes:
    buffer = io.BytesIO()
    pillow.fromarray(image).save(buffer, kind, **options)
    return buffer.getvalue()


def _pillow() -> Any:
    try:
        import PIL.Image
    except ImportError:
        raise MissingPrerequisiteError(LACKS.format("codec jpeg", "Pillow")) from None
    return PIL.Image


def _av() -> Any:
    try:
        import av
    except ImportError:
        raise MissingPrerequisiteError(LACKS.format("codec h264", "PyAV")) from None
    return av
