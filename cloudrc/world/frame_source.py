# SPDX-License-Identifier: Apache-2.0

"""Take the pictures of the robot's camera, and encode them.

In real time, a thread renders and encodes. A picture that is due meanwhile is not taken, and
counted as late: so a slow machine sends fewer pictures, not older ones.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Protocol

from cloudrc.config.camera import CameraConfig
from cloudrc.wire.endpoint import Outcome, Worker
from cloudrc.wire.pictures import Decoder, EncodedFrame, Encoder, Image, psnr


class Renderer(Protocol):
    """What renders, `physics.sim.camera.Camera`."""

    config: CameraConfig

    def aim(self) -> None:
        """Remember where everything in the flight is, for `render`."""

    def render(self) -> Image:
        """Return what the camera saw at the last `aim`."""


class FrameSource:
    """Takes the pictures of a session.

    Attributes:
        rate_hz: Number of pictures per second [Hz].
    """

    def __init__(
        self,
        camera: Renderer,
        make_codec: Callable[[], tuple[Encoder, Decoder]],
        worker: Worker | None,
        counts: Counter[str],
    ) -> None:
        """Connect the parts.

        Args:
            camera: What renders.
            make_codec: Makes an encoder, and a decoder as cloud has it, for each session.
            worker: Renders and encodes beside world; None: at once, in no time.
            counts: Gets the number of late pictures.
        """
        self._camera, self._make_codec, self._worker = camera, make_codec, worker
        self.rate_hz, self._counts = camera.config.fps, counts
        self._codec, self._taken = make_codec(), 0
        self._busy: tuple[int, int] | None = None  # session and stamp of what the worker has
        self._session = 0
        self._ready: EncodedFrame | None = None

    def begin_session(self) -> None:
        """Begin with picture 0, a key frame."""
        self._session, self._taken, self._ready = self._session + 1, 0, None
        self._codec = self._make_codec()

    def take(self, now_ns: int) -> None:
        """Take a picture at `now_ns` [ns], world's clock, unless the one before is not ready."""
        if self._busy is not None:
            self._counts["frames_late"] += 1
            return
        self._camera.aim()
        call = partial(self._make, *self._codec)
        number, self._taken = self._taken, self._taken + 1
        if self._worker is None:
            self._ready = call()._replace(stamp_ns=now_ns, number=number)
        else:
            self._busy = self._session, now_ns
            self._worker.begin(call, now_ns)

    def finished(self) -> EncodedFrame | None:
        """Return the picture that is ready, once."""
        if self._busy is not None and self._worker is not None:
            if (outcome := self._worker.take()) is not None:
                self._finish(outcome, *self._busy)
        ready, self._ready = self._ready, None
        return ready

    def _finish(self, outcome: Outcome, session: int, stamp_ns: int) -> None:
        """Take over what the worker made, unless it is of an earlier session."""
        self._busy = None
        if outcome.error is not None:
            raise outcome.error
        if session == self._session:
            made: EncodedFrame = outcome.result
            lasts_ns = outcome.done_ns - outcome.begun_ns
            self._ready = made._replace(
                stamp_ns=stamp_ns, number=self._taken - 1, encode_ns=lasts_ns
            )

    def _make(self, encoder: Encoder, decoder: Decoder) -> EncodedFrame:
        """Render and encode, in whichever thread."""
        image = self._camera.render()
        encoded = encoder.encode(image)
        decoded = decoder.decode(encoded.data)
        assert decoded is not None, "what was encoded can be decoded"
        return encoded._replace(psnr=psnr(image, decoded))
