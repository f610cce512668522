# SPDX-License-Identifier: Apache-2.0

"""Receive what the robot sees, scans and pictures, and give it to the perception."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

from cloudrc.cloud.frame_receiver import FrameReceiver
from cloudrc.cloud.perceiving import Perceiver
from cloudrc.cloud.perceptions import Frame
from cloudrc.wire.messages import RangeScan
from cloudrc.wire.records import Record
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import Kind
from cloudrc.wire.tunnel.window import USED, ReceiveWindow

KINDS = frozenset((int(Kind.SCAN), int(Kind.FRAME)))
"""Kinds of datagrams with what the robot sees."""


class SensorReceiver:
    """What the robot sees, as cloud gets it.

    Attributes:
        watch_scan: Is called with epoch, counter and content of each scan that cloud uses.
        watch_frame: Is called with each picture.
    """

    def __init__(
        self, perceiver: Perceiver | None, frames: FrameReceiver | None, counts: Counter[str]
    ) -> None:
        """Connect the parts.

        Args:
            perceiver: Makes setpoints of what the robot sees; None: that changes nothing.
            frames: Receives the pictures of the robot's camera; None: there are none.
            counts: Gets the number of scans that came late or twice.
        """
        self._perceiver, self._frames, self._counts = perceiver, frames, counts
        self._scans = ReceiveWindow(newest_wins=True)
        self.watch_scan: Callable[[int, int, RangeScan], None] | None = None
        self.watch_frame: Callable[[Frame], None] | None = None

    def begin_session(self, epoch: int) -> None:
        """Forget the session before, and begin with `epoch`."""
        self._scans.reset()
        if self._perceiver is not None:
            self._perceiver.begin_session()
        if self._frames is not None:
            self._frames.begin_session(epoch)

    def receive(
        self, kind: int, epoch: int, counter: int, body: Any, now_ns: int
    ) -> Sequence[Record]:
        """Handle a datagram of one of `KINDS` that arrived at `now_ns` [ns]; return new records."""
        if kind == Kind.SCAN:
            self._receive_scan(epoch, counter, body, now_ns)
            return ()
        fragment = codec.decode_fragment(body) if type(body) is bytes else body
        if self._frames is None:
            return ()
        for frame in self._frames.receive(fragment, now_ns):
            if self.watch_frame is not None:
                self.watch_frame(frame)
            if self._perceiver is not None:
                self._perceiver.receive_frame(frame, now_ns)
        return self._frames.take_records()

    def _receive_scan(self, epoch: int, counter: int, body: Any, now_ns: int) -> None:
        """Give a scan that is newer than all before to the perception."""
        outcome = self._scans.take(counter)
        scan = codec.decode_scan(body) if type(body) is bytes else body
        if outcome != USED:
            self._counts[f"scan_{outcome}"] += 1
            return
        if self.watch_scan is not None:
            self.watch_scan(epoch, counter, scan)
        if self._perceiver is not None:
            self._perceiver.receive_scan(scan, now_ns)
