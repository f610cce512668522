"""What the operator asks of the robot: requests come in, the guard is told, progress is kept."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable

from cloudrc.messages import OperatorRequest, Request, Start
from cloudrc.tunnel.codec import DecodeError
from cloudrc.world.guard import Guard
from cloudrc.world.touches import Touches

START_AGE_MAX_NS = 1_000_000_000
"""What cloud saw when it passed a start on may be so old [ns], or as old as a command may be."""


class Orders:
    """The operator's requests, obeyed by rising number.

    Attributes:
        number: Of the newest that was acted on in this session.
        mission_id: The mission started last, through every session.
        reached: How many of its waypoints are known to be reached; it only ever rises.
        touches: What the robot has touched in it.
    """

    def __init__(
        self, guard: Guard, counts: defaultdict[str, int], command_age_max_ns: int
    ) -> None:
        """Begin with nothing asked.

        Args:
            guard: Is told.
            counts: Takes up "start_refused".
            command_age_max_ns: Of a command's basis [ns].
        """
        self._guard, self._counts = guard, counts
        self._age_max_ns = max(START_AGE_MAX_NS, command_age_max_ns)
        self.number = self.mission_id = self.reached = 0
        self.touches = Touches()

    def obey(
        self,
        request: OperatorRequest,
        now_ns: int,
        *,
        waited: bool,
        has_epoch: Callable[[], bool],
    ) -> bool:
        """Do as is asked, but for a start, which the caller begins.

        Args:
            request: In the operator's name.
            now_ns: World's clock [ns].
            waited: Whether it may have waited in the socket through a stall.
            has_epoch: Whether there is an epoch for a start from the spawn.

        Returns:
            Whether a mission is to be started.

        Raises:
            DecodeError: "stale" or "future" for a start that was not said just now: somebody may
                have held it back, and the mission may be over.
        """
        if request.request is Request.PROGRESS:
            self._keep_progress(request)
            return False
        if request.number <= self.number:
            return False
        starts = request.request is Request.START
        if starts:
            self._refuse_unless_new(now_ns - request.basis_stamp_ns, waited)
            # Not acted on, so not confirmed either: the operator has to acknowledge first.
            if self._guard.latched or (request.start is Start.SPAWN and not has_epoch()):
                self._counts["start_refused"] += 1
                return False
        self.number = request.number
        if starts:
            self._begin_mission(request)
        self._keep_progress(request)
        if request.request is Request.END:
            self._guard.end_mission(now_ns)
        elif request.request is Request.ESTOP:
            self._guard.stop(now_ns)
        elif request.request is Request.ACKNOWLEDGE:
            self._guard.acknowledge(now_ns)
        return starts

    def _refuse_unless_new(self, age_ns: int, waited: bool) -> None:
        if waited or age_ns > self._age_max_ns:
            raise DecodeError("stale")
        if age_ns < 0:
            raise DecodeError("future")

    def _begin_mission(self, request: OperatorRequest) -> None:
        """From the spawn nothing is reached yet, and nothing touched."""
        if request.mission_id != self.mission_id or request.start is Start.SPAWN:
            self.mission_id, self.reached = request.mission_id, 0
            self.touches = Touches()

    def _keep_progress(self, request: OperatorRequest) -> None:
        """The onboard witness of how far a mission is."""
        if request.mission_id == self.mission_id:
            self.reached = max(self.reached, request.reached)
