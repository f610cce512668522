# SPDX-License-Identifier: Apache-2.0

"""Put the fragments of pictures together, and decode what can be decoded.

A picture is shown when its last fragment is there, and all that it needs: a key frame needs
nothing, another one the picture before it. Nothing is sent again. So after a loss, H.264 waits for
the next key frame, while of JPEG each picture is a key frame.
"""

from __future__ import annotations

from collections.abc import Callable

from cloudrc.cloud.perceptions import Frame
from cloudrc.wire.messages import Fragment
from cloudrc.wire.pictures import Decoder, Image
from cloudrc.wire.records import FrameKept, FrameShown

WINDOW = 64
"""Number of pictures by which one may be older than the newest before it is given up."""


class _Fragments:
    """The fragments of a picture that are there."""

    def __init__(self, first: Fragment) -> None:
        self.stamp_ns, self.key = first.stamp_ns, first.key
        self.parts: list[bytes | None] = [None] * first.fragments
        self.missing = first.fragments
        self.arrived_ns = 0  # when its last fragment arrived [ns]

    def add(self, given: Fragment, now_ns: int) -> None:
        place = given.fragment
        if place < len(self.parts) and self.parts[place] is None:
            self.parts[place] = given.data
            self.missing -= 1
            self.arrived_ns = now_ns

    @property
    def data(self) -> bytes:
        return b"".join(part for part in self.parts if part is not None)


class FrameReceiver:
    """Receives the pictures of a session.

    Attributes:
        records: What has become of the pictures, until `take_records`.
    """

    def __init__(
        self,
        make_decoder: Callable[[], Decoder],
        fovy: float,
        keep: Callable[[bytes, Image], tuple[str, bytes]] | None = None,
    ) -> None:
        """Set what decodes and keeps the pictures.

        Args:
            make_decoder: Makes a decoder that begins with a key frame.
            fovy: Angle from the lowest to the highest row [rad].
            keep: Returns format and content of the file to keep of a picture, from the data that
                have arrived and the picture; None: none is kept.
        """
        self._make_decoder, self._fovy, self._keep = make_decoder, fovy, keep
        self.records = list[FrameShown | FrameKept]()
        self.begin_session(0)

    def begin_session(self, epoch: int) -> None:
        """Expect picture 0, or another key frame, of the session `epoch`."""
        self._epoch, self._decoder = epoch, self._make_decoder()
        self._begun = dict[int, _Fragments]()
        self._next = 0  # number of the oldest picture that may still be shown
        self._newest = -1
        self._follows = False  # whether the decoder has the picture before `_next`

    def receive(self, fragment: Fragment, now_ns: int) -> list[Frame]:
        """Take what arrived at `now_ns` [ns], cloud's clock; return what is shown now."""
        number = fragment.number
        if number < max(self._next, self._newest - WINDOW):
            return []
        if number > self._newest:
            self._newest = number
            self._forget(number - WINDOW)
        found = self._begun.setdefault(number, _Fragments(fragment))
        found.add(fragment, now_ns)
        if found.missing:
            return []
        if found.key:
            if not (self._follows and number == self._next):
                self._decoder = self._make_decoder()
            self._next, self._follows = number, True
            self._forget(number)
        return self._show(now_ns)

    def take_records(self) -> list[FrameShown | FrameKept]:
        """Return the records made since the last call."""
        records, self.records = self.records, []
        return records

    def _forget(self, before: int) -> None:
        """Give up the pictures with a number below `before`."""
        for number in [each for each in self._begun if each < before]:
            del self._begun[number]

    def _show(self, now_ns: int) -> list[Frame]:
        """Decode the pictures that follow the last one without a gap."""
        shown = list[Frame]()
        while self._follows and (found := self._begun.get(self._next)) and not found.missing:
            number, data = self._next, found.data
            del self._begun[number]
            self._next += 1
            image = self._decoder.decode(data)
            self._follows = image is not None
            if image is None:
                break
            shown.append(Frame(found.stamp_ns, number, image, self._fovy))
            times_ns = found.stamp_ns, now_ns - found.arrived_ns
            self.records.append(FrameShown(now_ns, self._epoch, number, *times_ns))
            if self._keep is not None:
                self.records.append(FrameKept(now_ns, *self._keep(data, image)))
        return shown
