"""Where a mission aims: the robot as seen and the legs come in, setpoints go out.

A robot flies to what was aimed at last as soon as it is armed, whoever has armed it. So a mission
aims before its start is seen only if the robot cannot leave at once for the wrong place.
"""

from __future__ import annotations

from collections.abc import Callable

from cloudrc.cloud.teleop import mission_rules as rules
from cloudrc.cloud.teleop.messages import Continue, Seen
from cloudrc.cloud.teleop.plan import NO_PLAN, Plan
from cloudrc.cloud.teleop.request import Repeater
from cloudrc.messages import Setpoint, Start, Vector


class Aim:
    """Aims at the mission's waypoints, or at where the robot is seen.

    Attributes:
        setpoint: The last one; None before the first.
        awaited: Whether a mission is to be aimed as soon as that leads the right way.
    """

    def __init__(self, requests: Repeater, say: Callable[[Setpoint], None]) -> None:
        """Begin without a mission.

        Args:
            requests: What is asked of the robot; tells whether it waits.
            say: Gets every setpoint.
        """
        self.setpoint: Setpoint | None = None
        self.awaited = False
        self._requests = requests
        self._say = say
        self._seen: Seen | None = None
        self._plan = NO_PLAN
        self._mission_id = 0
        self._continued = False
        self._stays = False  # leads nowhere any more

    def see(self, seen: Seen) -> bool:
        """Take note of the newest telemetry.

        Returns:
            Whether it is the first of its session.
        """
        before, self._seen = self._seen, seen
        return before is None or before.epoch != seen.epoch

    def begin(self, plan: Plan, mission_id: int, before: Continue | None = None) -> None:
        """A mission begins; one that goes on and is held aims at nothing before it is resumed.

        Args:
            plan: Whose waypoints are aimed at.
            mission_id: Names it on board; 0 for not at all.
            before: How it stood, if it goes on.
        """
        self._plan = plan
        self._mission_id = mission_id
        self._continued = before is not None
        self.awaited = before is None or not before.held

    def ahead(self, leg: int) -> None:
        """Aim before the start is seen: the first command that is flown then leads the right way.

        Not while the robot may still fly a mission whose end was lost: it would leave at once, past
        the spawn, for a waypoint that is to be flown to from there.

        Args:
            leg: Index of the waypoint, as far as teleop knows; the robot may know of more.
        """
        seen, from_spawn = self._seen, self._from_spawn
        if not self.awaited or seen is None or (from_spawn and not self._requests.waits):
            return
        self.awaited = False
        onboard = rules.known_on_board(seen, self._mission_id)
        leg = 0 if from_spawn else max(leg, onboard)
        if leg < len(self._plan.legs):
            self.at(leg)

    def again(self, *, starting: bool) -> None:
        """Cloud forgets the setpoint with its session: somebody else may have moved the robot.

        Args:
            starting: Whether the mission's start has not been seen yet.
        """
        if starting and self._from_spawn and not self._requests.waits:
            self.awaited = True
            self.here()
        elif self.setpoint is not None:
            self._aim(self.setpoint)

    def started(self, leg: int) -> None:
        """The start is seen: what is not aimed yet aims at the waypoint of this index."""
        if self.awaited:
            self.awaited = False
            self.at(leg)

    def at(self, leg: int) -> None:
        """Aim at the waypoint of this index, unless the robot is to stay."""
        to = self._plan.legs[leg]
        if not self._stays:
            self._aim(Setpoint(to.position, to.yaw, leg))

    def at_point(self, position: Vector, yaw: float) -> None:
        """Aim at a point that is no waypoint: position [m], world frame, shape (3,); yaw [rad]."""
        self._aim(Setpoint(position, yaw, rules.NO_WAYPOINT))

    def here(self) -> None:
        """Aim at where the robot is seen, if it is."""
        if self._seen is not None:
            self._aim(rules.held_at(self._seen, self.setpoint))

    def stay(self) -> None:
        """Aim at where the robot is seen, and at no waypoint from now on."""
        self.here()
        self._stays = True

    @property
    def _from_spawn(self) -> bool:
        """Whether the robot is put to the spawn first; one that goes on is not."""
        return self._plan.start is Start.SPAWN and not self._continued

    def _aim(self, setpoint: Setpoint) -> None:
        epoch = 0 if self._seen is None else self._seen.epoch
        self.setpoint = setpoint._replace(epoch=epoch)
        self._say(self.setpoint)
