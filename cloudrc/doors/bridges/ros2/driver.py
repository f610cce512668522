# SPDX-License-Identifier: Apache-2.0

"""Real time: a process beside cloud that exchanges messages with nodes of ROS 2.

Cloud never waits for ROS: it exchanges datagrams with this process. The newest answer wins.
"""

from __future__ import annotations

import select
import threading
import time
from collections.abc import Callable
from typing import Any

from cloudrc.base.errors import ControllerLostError
from cloudrc.doors.bridges.ros2.node import WAKE, RosAnswer, RosNode
from cloudrc.flight.pod.openpi.codec import pack, unpack
from cloudrc.flight.pod.teleop_link import UnixDatagrams

LOOK_PERIOD = 0.5
"""Time between two looks at the nodes [s], and the silence after which cloud is told about it."""
STRANGE_MAX = 20
"""Number of answers in a row with a stamp that no estimate had, with which the flight ends."""

REPEATS_MAX = 10
"""Number of answers within `LOOK_PERIOD` to an answered estimate, above which two nodes answer."""


class RosDriver:
    """Publishes cloud's observations, and sends the answers of a user's node to cloud."""

    def __init__(self, peer: UnixDatagrams, namespace: str, tell: Callable[[str], None]) -> None:
        """Exchange datagrams with cloud by `peer`; `tell` gets words for the user."""
        self._peer, self._tell = peer, tell
        self._node = RosNode(namespace, virtual=False)
        self._episode, self._sent_ns = 0, 0  # of the newest observation
        self._strange = self._repeats = 0
        self._answered_ns: int | None = None  # stamp of the newest answer
        self._late = ""  # what to say if answers come, but too late
        self._ended = False

    def run(self, stop: Callable[[], bool]) -> None:
        """Serve cloud until `stop()` is true."""
        listener = threading.Thread(target=self._listen, daemon=True)
        listener.start()
        while not stop():
            if select.select([self._peer], [], [], WAKE)[0]:
                arrived = self._peer.receive_data()
                if arrived:
                    self._publish(unpack(arrived[-1]))  # only the newest observation counts
        self._ended = True
        listener.join()
        self._node.close()

    def _publish(self, message: dict[str, Any]) -> None:
        self._episode, self._sent_ns = message["episode"], message["sent_ns"]
        self._node.publish(message["observation"], (self._episode, self._sent_ns))

    def _listen(self) -> None:
        heard = looked = time.monotonic()
        while not self._ended:
            try:
                answer = self._node.take(WAKE)
                now = time.monotonic()
                if answer is not None:
                    heard = now
                    self._send(self._answer(answer))
                if now - looked > LOOK_PERIOD:
                    looked = now
                    self._look(silent=now - heard > LOOK_PERIOD)
            except ControllerLostError as error:
                self._send({"invalid": str(error)})

    def _look(self, *, silent: bool) -> None:
        crowded, self._repeats = self._repeats > REPEATS_MAX, 0
        if word := self._node.check(crowded=crowded):
            self._tell(word)
        self._late = f"{self._node.who()} answers too late"
        if silent:
            self._send({"trouble": self._node.silence()})

    def _answer(self, answer: RosAnswer) -> dict[str, Any]:
        """Return what cloud is told about an answer."""
        known: tuple[int, ...] = (self._episode, self._sent_ns)
        if answer.stamp_ns is not None:
            known = self._node.asked.get(answer.stamp_ns, ())
            self._repeats += answer.stamp_ns == self._answered_ns
            self._answered_ns = answer.stamp_ns
        if known:
            self._strange = 0
            flown = {"episode": known[0], "sent_ns": known[1], "rows": [answer.row]}
            return {**flown, "trouble": self._late}
        self._strange += 1
        text = "answers with a stamp that no estimate has: copy its header.stamp"
        error = self._node.invalid(text)
        return {"trouble" if self._strange < STRANGE_MAX else "invalid": str(error)}

    def _send(self, message: dict[str, Any]) -> None:
        self._peer.send_data(pack({"episode": self._episode, "sent_ns": 0, **message}))
