# SPDX-License-Identifier: Apache-2.0

"""Queue missions, carry out the operator's commands, and report the robot's state."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from math import hypot, inf
from typing import Any

import numpy as np

from cloudrc.base.text import describe_point
from cloudrc.physics.geometry.clearance import NO_SIZE, Spheres
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.obstacles import obstacles, surface
from cloudrc.physics.geometry.placement import find_crossed
from cloudrc.physics.geometry.scene import Scene
from cloudrc.results.metrics.verdict import FlightFailure, FlightVerdict
from cloudrc.teleop.carrot import HEARTBEAT_NS, SPEED_MAX, TURN_MAX
from cloudrc.teleop.refusals import ConflictError, UnavailableError
from cloudrc.teleop.runner import STOP_IS_SENT, MissionRunner
from cloudrc.teleop.store import MissionRecord, MissionStore, Order
from cloudrc.teleop.view import DRIVEN
from cloudrc.teleop.wire import HELD, Leg, Plan
from cloudrc.wire.messages import Start, Vector

DRIVE_LIMIT = 3600.0
"""Time limit of a mission that begins with a request to drive [s]."""
CANCELLED = "mission cancelled"


class Hand:
    """The operator's requests to drive.

    After a hold, a stop or the end of a mission, the operator can drive on only after a request for
    zero velocity, or after a pause of `HEARTBEAT_NS`: he has to let go.
    """

    def __init__(self, speed_max: float) -> None:
        """Limit velocities to `speed_max` [m/s], and to `SPEED_MAX`."""
        self._speed_max, self._driven_ns = min(speed_max, SPEED_MAX), -HEARTBEAT_NS
        self.has_to_let_go = False

    def is_there(self, now_ns: int) -> bool:
        """Return whether the operator has driven within `HEARTBEAT_NS` before `now_ns` [ns]."""
        return now_ns - self._driven_ns <= HEARTBEAT_NS

    def limit(self, velocity: Vector, now_ns: int, *, turns: bool) -> Vector:
        """Return the velocity [m/s] for a request at `now_ns` [ns]; `turns`: it asks for a turn."""
        x, y, z = velocity
        scale = self._speed_max / max(hypot(x, y, z), self._speed_max)
        if not (any(velocity) or turns) or not self.is_there(now_ns):
            self.has_to_let_go = False
        self._driven_ns = now_ns
        return scale * x, scale * y, scale * z


class MissionService(MissionRunner):
    """Stores and flies all missions of one robot, as the operator commands.

    The methods for the operator's commands raise ConflictError if the state of mission or robot
    forbids the command. They raise UnavailableError if the disk takes no mission, or if this
    process ends.
    """

    def __init__(
        self,
        book: MissionStore,
        fence: Fence,
        scene: Scene | None = None,
        hull: Spheres = NO_SIZE,
        units: Mapping[str, str] | None = None,
        *,
        speed_max: float = SPEED_MAX,
    ) -> None:
        """Begin with the missions in the store `book`, in a scene with `fence`.

        With a `scene`, the service forbids straight ways of the robot's `hull` through obstacles.
        `units` are the names of the robot's own sensors, in the order of telemetry, and their units
        (None: no sensors). `speed_max` is the guard's speed limit [m/s]: a drive by hand is not
        faster, and never faster than `SPEED_MAX`.
        """
        super().__init__(book, fence, units or {})
        self._scene, self._hull, self._hand = scene, hull, Hand(speed_max)
        self._renewed_ns: dict[str, int] = {}  # mission's id -> time of its watcher's last word

    def create(self, order: Order, now_ns: int) -> tuple[MissionRecord, bool]:
        """Create a mission that starts at once or waits; return it, and whether it is new.

        If an earlier order has the same `key`, return the mission of the earlier order.
        """
        known = self.book.with_key(order.key)
        if known is not None:
            self._renewed_ns[known.id] = now_ns
            if (known.order.plan, known.order.touch) != (order.plan, order.touch):
                text = f"mission {known.id} has the key '{order.key}' already, with another plan"
                raise ConflictError(f"{text}; take a new key", known.id)
            return known, False
        waiting = self.book.open()
        if waiting and not order.queue:
            raise _busy(waiting[0], "cancel it first, or queue the new one")
        self._check_can_fly()
        if order.plan.start is Start.HERE and not waiting and not order.plan.by_hand:
            self._check_way(order.plan.legs[0], order)
        mission = self.book.add(order)
        self._renewed_ns[mission.id] = now_ns
        if waiting:
            self.note(mission, "queued", f"mission waits for {waiting[-1].id}", now_ns)
        else:
            self.start_next(now_ns, queued=True)
        return mission, True

    def renew(self, mission_id: str, now_ns: int) -> MissionRecord:
        """Note that the mission's watcher lives; raise UnknownMissionError for a wrong id."""
        mission = self.book.find(mission_id)
        self._renewed_ns[mission.id] = now_ns
        return mission

    def cancel(self, mission_id: str, now_ns: int, why: str = "") -> MissionRecord:
        """End a mission, or remove it from the queue; raise UnknownMissionError for a wrong id.

        `why` follows the words "mission cancelled"; "" if an operator asks for it.
        """
        mission, why = self.book.find(mission_id), why and f": {why}"
        if not mission.ended and mission is self.start_next(now_ns):
            text = CANCELLED + why
            return self.operate(lambda flight: flight.end(now_ns, "cancelled", text), now_ns)
        if mission.ended:  # maybe just now, because world has restarted
            raise ConflictError(f"mission {mission.id} has ended: {mission.state}", mission.id)
        text = f"{CANCELLED} before it began{why}"
        verdict = FlightVerdict("interrupted", (FlightFailure("cancelled", text),)).as_json()
        self.note(mission, "cancelled", text, now_ns, verdict=verdict)
        if self.book.trouble:
            text = f"{mission.id} is cancelled, but waits again if teleop restarts"
            raise UnavailableError(f"{text}: {self.book.trouble}")
        return mission

    def hold(self, now_ns: int) -> MissionRecord:
        """Interrupt the mission under way: the robot holds its position."""
        self._hand.has_to_let_go = True
        return self.operate(lambda flight: flight.hold(now_ns), now_ns)

    def resume(self, now_ns: int) -> MissionRecord:
        """Continue the held mission, straight to the next waypoint."""
        self._check_can_fly()
        if (mission := self.current) is not None and mission.state == HELD:
            self._check_way(mission.order.plan.legs[mission.waypoint], mission.order)
        return self.operate(lambda flight: flight.resume(now_ns), now_ns)

    def go_to(self, leg: Leg, now_ns: int) -> MissionRecord:
        """Fly straight to a point, during a held mission or as a new mission."""
        self._check_can_fly()
        waiting = self.book.open()
        if not waiting:
            plan = Plan((leg,), Start.HERE, leg.time_limit)
            return self.create(Order(plan, "goto"), now_ns)[0]
        if waiting[0].state != HELD:
            raise _busy(waiting[0], "hold or cancel it first")
        self._check_way(leg, waiting[0].order)
        return self.operate(lambda flight: flight.go_to(now_ns, leg), now_ns)

    def drive(self, velocity: Vector, now_ns: int, yaw_rate: float | None = None) -> MissionRecord:
        """Drive the setpoint with `velocity` [m/s], in a held mission or in a new one.

        With a `yaw_rate` [rad/s] it also turns, and `velocity` is in the frame of its heading.

        The setpoint brakes and rests if the next request comes later than `HEARTBEAT_NS`.
        """
        velocity = self._hand.limit(velocity, now_ns, turns=bool(yaw_rate))
        if yaw_rate:
            yaw_rate = max(-TURN_MAX, min(yaw_rate, TURN_MAX))
        self._check_can_fly()
        if self._hand.has_to_let_go:
            raise ConflictError("a hold, a stop or an end came in between; let go, then drive on")
        waiting, seen = self.book.open(), self.seen
        if not waiting:
            if seen is None or not (any(velocity) or yaw_rate):
                text = "no mission is under way; a velocity other than zero makes the robot start"
                raise ConflictError(f"{text}, once telemetry has arrived")
            x, y, z = seen.position
            leg = Leg((x, y, max(z, self._fence.inner_low[2])), tolerance=inf, dwell=0.0)
            plan = Plan((leg,), Start.HERE, DRIVE_LIMIT, by_hand=True)
            self.create(Order(plan, "drive"), now_ns)
        elif waiting[0].state != HELD and not waiting[0].order.plan.by_hand:
            raise _busy(waiting[0], "hold or cancel it first")
        return self.operate(lambda flight: flight.drive(now_ns, velocity, yaw_rate), now_ns)

    def switch_off(self, now_ns: int) -> MissionRecord | None:
        """Switch the robot off at once, in any state; return the mission that this ends, if any."""
        self._hand.has_to_let_go = True
        mission = self.start_next(now_ns)
        self._teleop.stop(now_ns)
        self.collect(now_ns)
        return mission

    def acknowledge(self, now_ns: int) -> None:
        """Let the robot fly again after a landing or a stop, if no mission is under way.

        Raise a ConflictError while a stop is repeated: the next copy would stop the robot again.
        """
        if self.current is not None:
            raise _busy(self.current, "there is nothing to acknowledge")
        if self.stop_is_sent:
            text = "acknowledge again once 'cloudrc mission status' shows ESTOP"
            raise ConflictError(f"{STOP_IS_SENT}; {text}")
        self._hand.has_to_let_go = True
        self._teleop.acknowledge()
        self.collect(now_ns)

    def pause(self, now_ns: int) -> None:
        """Pause the mission under way because this process ends; the next process continues it."""
        self.ends = True
        if self.start_next(now_ns) is not None:
            self.operate(lambda flight: flight.pause(now_ns), now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Cancel what nobody watches, then do what is due."""
        if not self.ends:
            self._cancel_unwatched(now_ns)
        super().handle_deadline(now_ns)

    def collect(self, now_ns: int) -> None:
        """Take teleop's outputs; after the end of a mission, whoever drives has to let go."""
        before = self.current
        super().collect(now_ns)
        if before is not None and self.current is None:
            self._hand.has_to_let_go = True

    def state(self, now_ns: int) -> dict[str, Any]:
        """Return the state of missions and robot in the form of the API's `StateView`."""
        mission, seen = self.current, self.seen
        return {
            "mission": mission.summary() if mission is not None else None,
            "queue": [waits.id for waits in self.book.open() if waits is not mission],
            "cloud_age_s": self._view.cloud_age(now_ns),
            "seen": seen and self._view.show(seen, self._steered_state(now_ns), now_ns),
        }

    def _steered_state(self, now_ns: int) -> str | None:
        """Return the state of the mission under way; DRIVEN while somebody drives the robot."""
        if self.current is None:
            return None
        is_driven = self._hand.is_there(now_ns) and not self._hand.has_to_let_go
        return DRIVEN if self.current.state == HELD and is_driven else self.current.state

    def _check_can_fly(self) -> None:
        if self.ends:
            raise UnavailableError("teleop ends; repeat this when teleop runs again")
        if self.blocked:
            raise ConflictError(
                f"{self.blocked}; find the cause, then: cloudrc mission acknowledge"
            )

    def _check_way(self, leg: Leg, order: Order) -> None:
        """Raise ConflictError if an obstacle lies between the robot and the waypoint of `leg`."""
        if self.seen is None or self._scene is None:
            return
        here, there = self.seen.position, leg.position
        known = obstacles(self._scene, touch=order.touched)
        through = int(find_crossed(known, self._hull, np.array([here]), np.array([there]))[0])
        if through >= 0:
            way = f"from where the robot is, {describe_point(here)}, to {describe_point(there)}"
            text = f"the straight way {way} leads through {surface(known[through])}"
            mission = self.current.id if self.current else ""
            raise ConflictError(f"{text}; go round it first, by another target", mission)

    def _cancel_unwatched(self, now_ns: int) -> None:
        """Cancel each mission whose watcher has sent no word for the time of its lease.

        A new teleop process gives each watcher its full time again.
        """
        for mission in self.book.open():
            lease = mission.order.lease
            renewed_ns = self._renewed_ns.setdefault(mission.id, now_ns)
            if lease and now_ns - renewed_ns > lease * 1e9:
                why = f"its watcher is gone (no word from it for {lease:g} s)"
                with suppress(ConflictError, UnavailableError):  # it has just ended
                    self.cancel(mission.id, now_ns, why)


def _busy(mission: MissionRecord, advice: str) -> ConflictError:
    return ConflictError(f"mission {mission.id} is {mission.state}; {advice}", mission.id)
