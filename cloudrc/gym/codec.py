# SPDX-License-Identifier: Apache-2.0

"""Encode the images of an observation for their way to the policy, and decode what arrives.

An observation is one message: its images as they are encoded, and the bytes of its other arrays. So
all of it arrives, or nothing. With H.264, an observation whose image cannot be decoded is kept from
the policy, as cloud's receiver of pictures decides: after a gap, up to the next key frame.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from math import nan
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from gymnasium import spaces

from cloudrc.base.outside.values import to_arrays
from cloudrc.cloud.frame_receiver import FrameReceiver
from cloudrc.cloud.perceptions import Frame
from cloudrc.config.camera import CodecConfig
from cloudrc.gym.executors import Committed
from cloudrc.gym.lane import Wire
from cloudrc.gym.values import copied, size_of
from cloudrc.wire.messages import Fragment
from cloudrc.wire.pictures import EncodedFrame, make_decoder, make_encoder


class Coded(NamedTuple):
    """An observation as it travels."""

    number: int  # of those that the robot has sent in the episode
    images: tuple[EncodedFrame, ...]
    rest: Any  # the observation, with () in place of its images
    size: int  # [bytes]


Message: TypeAlias = tuple[int, Committed, Any, dict[str, Any]]
"""Tick, what the robot had when it was sent, observation, and the environment's info."""


def shapes_of(space: spaces.Space[Any]) -> Iterator[tuple[int, ...]]:
    """Yield the shapes of the images of an observation, (height, width, 3), in their order."""
    if isinstance(space, spaces.Dict | spaces.Tuple):
        parts = space.values() if isinstance(space, spaces.Dict) else space.spaces
        for part in parts:
            yield from shapes_of(part)
    elif _is_image(space):
        yield space.shape or ()


def _is_image(space: spaces.Space[Any]) -> bool:
    if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
        return False
    return len(space.shape) == 3 and space.shape[2] == 3


def _change(space: spaces.Space[Any], value: Any, change: Callable[[Any], Any]) -> Any:
    """Return a copy of an observation in which its images are changed, in their order."""
    if isinstance(space, spaces.Dict):
        return {key: _change(part, value[key], change) for key, part in space.items()}
    if isinstance(space, spaces.Tuple):
        parts = zip(space.spaces, value, strict=True)
        return tuple(_change(part, each, change) for part, each in parts)
    return change(value) if _is_image(space) else copied(value)


class ObservationCodec:
    """Encodes and decodes the observations of an episode."""

    def __init__(self, space: spaces.Space[Any], codec: CodecConfig, dt: float) -> None:
        """Set the space of an observation; `dt` is the time of a step [s].

        Raises:
            MissingPrerequisiteError: If the package of the codec is not installed.
        """
        self._space, self._codec, self._dt = space, codec, dt
        self._shapes = [*shapes_of(space)]
        self._restart()

    def _restart(self) -> None:
        codec, rate_hz = self._codec, 1.0 / self._dt
        self._encoders = [
            make_encoder(codec, width, height, rate_hz) for height, width, _ in self._shapes
        ]
        decoder = partial(make_decoder, codec.codec)
        self._receivers = [FrameReceiver(decoder, nan) for _ in self._shapes]
        self._waiting = dict[int, Message]()  # arrived, but what they need is not there
        self._sent = self._bytes = self._shown = 0

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has; a codec with a state between pictures cannot be copied."""
        if self._codec.codec == "h264":
            raise TypeError("an episode with the codec h264 cannot be copied; choose jpeg")
        return vars(self)

    def begin(self, observation: Any) -> tuple[Any, int]:
        """Begin an episode, in which the policy has the first observation at once.

        Returns:
            The observation as the policy sees it, and the usual size of one [bytes]: that of the
            first; with H.264, whose first one is larger, what its bit rate says.
        """
        self._restart()
        first = self.encode(observation)
        ((_, _, seen, _),) = self.receive((0, Committed(), first, {}))
        self._bytes = self._shown = 0  # it does not cross the link
        if self._codec.codec == "jpeg":
            return seen, first.size
        rate = self._codec.kbit * 1000.0 / 8.0 * len(self._shapes)
        return seen, size_of(first.rest) + round(rate * self._dt)

    def encode(self, observation: Any) -> Coded:
        """Encode the next observation that the robot sends."""
        images, encoders = list[EncodedFrame](), iter(self._encoders)

        def take(image: Any) -> tuple[()]:
            plain = np.ascontiguousarray(to_arrays(image))
            images.append(next(encoders).encode(plain))
            return ()

        rest = _change(self._space, observation, take)
        size = size_of(rest) + sum(len(each.data) for each in images)
        number, self._sent = self._sent, self._sent + 1
        self._bytes += size
        return Coded(number, tuple(images), rest, size)

    def receive(self, message: Message) -> list[Message]:
        """Take a message whose observation is `Coded`; return those that can be decoded now."""
        coded: Coded = message[2]
        self._waiting[coded.number] = message
        every = list[list[Frame]]()
        for receiver, image in zip(self._receivers, coded.images, strict=True):
            whole = Fragment(0, coded.number, 0, 1, image.key, image.data)
            every.append(receiver.receive(whole, 0))
            receiver.take_records()
        return [self._decoded(frames) for frames in zip(*every, strict=True)]

    def _decoded(self, frames: Sequence[Frame]) -> Message:
        """Return the message of which these are the images."""
        number, images = frames[0].number, iter(frames)
        tick, committed, coded, info = self._waiting[number]
        seen = _change(self._space, coded.rest, lambda _: next(images).image)
        self._waiting = {n: each for n, each in self._waiting.items() if n > number}
        self._shown += 1
        return tick, committed, seen, info

    def told(self, wire: Wire) -> dict[str, float]:
        """Return what the summary of an episode has in place of, and beside, that of a `wire`.

        That is the mean size of the observations after the first [bytes], the time for which it
        occupies the bottleneck [s], and which share of them reached the policy as images.
        """
        sent = self._sent - 1
        if not sent:
            return {"shown": nan}
        mean = self._bytes / sent
        on_link = wire._replace(size=round(mean)).occupies
        return {"bytes": mean, "on_link": on_link, "shown": self._shown / sent}
