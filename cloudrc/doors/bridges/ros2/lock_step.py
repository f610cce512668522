# SPDX-License-Identifier: Apache-2.0

"""Virtual time: each estimate waits for the answer of a node of ROS 2 with the same stamp."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from cloudrc.base.errors import ControllerLostError
from cloudrc.doors.bridges.ros2.node import WAKE, RosNode
from cloudrc.flight.pod.transports.remote import SILENT, VIRTUAL_LIMIT

SETTLE = 0.2
"""Time after both ends are found until the first estimate [s]: the node must have found us, too."""
REPEAT = 1.0
"""Time after which the very first estimate is published again [s]: it may have been lost."""
MET_PERIOD = 0.02
"""Time between two looks for a node [s]."""


class RosLockStep:
    """The way to a user's node in virtual time, which stands still until the answer arrives."""

    def __init__(self, namespace: str, start_limit: float, gone: Callable[[], bool]) -> None:
        """Wait for a node below `namespace`; `start_limit` limits this and the first answer [s].

        `gone` says whether the user's program has ended, so that waiting is useless.
        """
        self._start_limit = self._limit = start_limit
        self._gone = gone
        self._node = RosNode(namespace, virtual=True)
        # Stamps of the newest answer, and of an estimate that was published again [ns].
        self._answered_ns: int | None = None
        self._repeated_ns: int | None = None
        try:
            self._meet()
        except ControllerLostError:
            self._node.close()
            raise

    def close(self) -> None:
        """Leave the program."""
        self._node.close()

    def _meet(self) -> None:
        began = time.monotonic()
        while not self._node.is_met:
            self._node.check()
            waited = time.monotonic() - began
            if waited > self._start_limit or self._gone():
                raise self._silent(waited)
            time.sleep(MET_PERIOD)
        time.sleep(SETTLE)
        self._node.check()

    def begin(self) -> None:
        """Begin an episode: its first answer may take longer."""
        self._limit = self._start_limit

    def exchange(self, observation: dict[str, Any]) -> tuple[float, list[list[float]]]:
        """Return the age of the observation, 0 s, and the row of the answer."""
        stamp_ns = self._node.publish(observation)
        began = again = time.monotonic()
        while True:
            answer = self._node.take(WAKE)
            now = time.monotonic()
            if answer is not None:
                if answer.stamp_ns == stamp_ns:
                    break
                self._check_other(answer.stamp_ns, stamp_ns)
                continue
            limit = min(self._limit, VIRTUAL_LIMIT) if self._gone() else self._limit
            if now - began > limit:
                self._node.check()
                raise self._silent(limit)
            if self._answered_ns is None and now - again > REPEAT:
                self._node.check()  # ROS may have found the node's topics one by one
                again, self._repeated_ns = now, stamp_ns
                self._node.publish_again(observation, stamp_ns)
        self._answered_ns, self._limit = stamp_ns, VIRTUAL_LIMIT
        return 0.0, [answer.row]

    def _check_other(self, answered_ns: int | None, stamp_ns: int) -> None:
        """Raise an error for an answer to another estimate, unless cloudrc repeated that one."""
        if answered_ns is not None and answered_ns == self._repeated_ns:
            return
        twice = answered_ns == self._answered_ns
        self._node.check(crowded=twice)  # a second node may have come
        if twice:
            raise self._node.invalid("answers an estimate twice: publish one command for each")
        given = "-" if answered_ns is None else f"{answered_ns * 1e-9:.9f}"
        raise self._node.invalid(
            f"answers with the stamp {given}, not with that of the estimate, "
            f"{stamp_ns * 1e-9:.9f}: copy its header.stamp"
        )

    def _silent(self, waited: float) -> ControllerLostError:
        return ControllerLostError(SILENT, self._node.silence(waited))
