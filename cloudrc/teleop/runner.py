# SPDX-License-Identifier: Apache-2.0

"""Fly the missions of a store one after the other, and write down what happens.

A new teleop process continues the mission of the earlier process at the same waypoint, unless world
has restarted. If an emergency stop has not reached the robot, the new process sends it again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from cloudrc.base.text import describe_point
from cloudrc.physics.geometry.fence import Fence
from cloudrc.results.metrics.flight import finite
from cloudrc.results.metrics.verdict import Observations, judge
from cloudrc.teleop.interruptions import SILENCE, Interruptions
from cloudrc.teleop.mission import MissionFlight, Teleop
from cloudrc.teleop.refusals import ConflictError
from cloudrc.teleop.store import MissionRecord, MissionStore
from cloudrc.teleop.view import RobotView
from cloudrc.teleop.wire import FLYING, HELD, QUEUED, EventName, Output, RobotStatus
from cloudrc.wire.messages import GuardState, Setpoint
from cloudrc.wire.records import Fault, MissionEvent

_, TRACK, HOLD, LAND, ESTOP = GuardState
LATCHED, AIRBORNE = (LAND, ESTOP), (TRACK, HOLD, LAND)
"""States of the guard that only an acknowledgement ends; states in which the robot may move."""
SETPOINT_PERIOD_NS = 100_000_000
"""Time between two copies of the setpoint [ns]; a cloud that restarts needs the copies."""
STOP_IS_SENT = "an emergency stop is on its way to the robot"


class MissionRunner:
    """Flies the missions of one robot; all times `now_ns` are this process's monotonic clock [ns].

    Attributes:
        book: The missions.
        current: The mission under way; None without one.
        ends: Whether this process ends; the next process flies the queue.
        failed: Number of missions whose verdict in this process was a failure.
    """

    def __init__(self, book: MissionStore, fence: Fence, units: Mapping[str, str]) -> None:
        """Begin with the missions in the store `book`, in a scene with `fence`.

        `units` are the names of the robot's own sensors and their units.
        """
        self.book, self.ends = book, False
        self.current: MissionRecord | None = None
        self.failed = 0
        self._teleop, self._fence = Teleop(fence, book.has_ended), fence
        self._view = RobotView(units)
        self._outputs: list[Output | Fault] = []
        self._setpoint_ns = 0  # time of the next copy of the setpoint
        self._began_ns = 0  # when this process began to fly the present mission
        self._interruptions = Interruptions()  # of the present mission
        self._trouble = ""  # trouble of the store that was last reported

    @property
    def seen(self) -> RobotStatus | None:
        """The newest telemetry; None before the first telemetry."""
        return self._teleop.seen

    @property
    def settled(self) -> bool:
        """Whether telemetry shows that the robot has acted on the last request."""
        return self._teleop.settled

    @property
    def over(self) -> bool:
        """Whether missions exist, all have ended, and no request is left to carry out."""
        return bool(self.book.missions) and not self.book.open() and self.settled

    @property
    def stop_is_sent(self) -> bool:
        """Whether telemetry does not show yet that the robot has obeyed an emergency stop."""
        return self._teleop.stopping or self._inherits_stop is not None

    @property
    def blocked(self) -> str:
        """Why the robot cannot fly until the operator's acknowledgement; "" if it can fly."""
        if self.stop_is_sent:
            return STOP_IS_SENT
        seen = self.seen
        if seen is None or seen.guard not in LATCHED:
            return ""
        return f"the guard is in {seen.guard.name} ({seen.cause.words}) and lets nothing fly"

    def operate(self, act: Callable[[MissionFlight], None], now_ns: int) -> MissionRecord:
        """Let the operator act on the mission under way; raise ConflictError without one."""
        mission = self.current
        if mission is None:
            raise ConflictError("no mission is under way")
        act(self._flight)
        self.collect(now_ns)
        return mission

    def start_next(self, now_ns: int, *, queued: bool = False) -> MissionRecord | None:
        """If no mission is under way, start the oldest mission that has not ended.

        If an earlier teleop process has started that mission, continue it. If it is queued, start
        it only if `queued` is True, and only after its new state is on the disk. Return the mission
        that is under way after this call, or None.
        """
        waiting = self.book.open()
        if self.current is not None or not waiting:
            return self.current
        mission = waiting[0]
        if queued and mission.state == QUEUED:
            self.note(mission, "starting", "the robot is asked to start", now_ns)
        if mission.world or (mission.state != QUEUED and not self.book.trouble):
            self.current, self._began_ns = mission, now_ns
            self._interruptions = Interruptions()
            self._teleop.start(now_ns, mission)
            if mission.world:  # an earlier teleop has begun it
                text = "teleop has restarted; the robot is asked to go on"
                self.note(mission, "restarted", text, now_ns)
        self.collect(now_ns)
        return self.current

    def hear(self, now_ns: int) -> None:
        """Record that a message from cloud has arrived at `now_ns`."""
        self._view.heard_ns = now_ns

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Process telemetry that has arrived at `now_ns`."""
        before, mission = self.seen, self.current
        if self._inherits_stop and seen.mission_id == self._inherits_stop.number:
            if seen.guard in AIRBORNE:  # the stop has not reached the robot
                self._teleop.stop(now_ns)
        self._view.see(before, seen, now_ns)
        if mission is not None:
            flight = self._flight
            if (mission.number, mission.world) == (seen.mission_id, seen.world):
                self._witness(mission, seen, now_ns)
                if before is not None and before.epoch != seen.epoch:
                    text = f"cloud has a new session; the mission is {mission.state}"
                    self.note(mission, "new_session", f"{text} {flight.route.where}", now_ns)
            time, flies = flight.elapsed(now_ns), mission.state in (FLYING, HELD)
            for event, text in self._interruptions.see(seen, time, flies=flies):
                self.note(mission, event, text, now_ns)
        self._teleop.see(seen, now_ns)
        self.collect(now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Start a waiting mission, check time limits, and repeat the messages that are due."""
        self.book.catch_up(now_ns)
        if not self.ends:
            blocked = self.seen is None or self.book.trouble or self.blocked
            self.start_next(now_ns, queued=not blocked)
        self._tell_silence(now_ns)
        self._teleop.handle_deadline(now_ns)
        self.collect(now_ns)
        setpoint = self._teleop.aim.setpoint
        if setpoint is not None and now_ns >= self._setpoint_ns:
            self._setpoint_ns = now_ns + SETPOINT_PERIOD_NS
            self._outputs.append(setpoint)

    def take_outputs(self) -> list[Output | Fault]:
        """Return the messages for cloud and the faults for teleop's log, oldest first."""
        outputs, self._outputs = self._outputs, []
        return outputs

    def collect(self, now_ns: int) -> None:
        """Take teleop's outputs, and write down its events."""
        for output in self._teleop.take_outputs():
            if isinstance(output, Setpoint):
                self._setpoint_ns = now_ns + SETPOINT_PERIOD_NS
            elif isinstance(output, MissionEvent):
                self._process_event(output, now_ns)
            self._outputs.append(output)
        told, self._trouble = self._trouble, self.book.trouble
        if self._trouble not in ("", told):
            self._outputs.append(Fault(now_ns, "journal", self._trouble))

    def note(
        self, mission: MissionRecord, event: EventName, text: str, now_ns: int, **changed: Any
    ) -> None:
        """Store an event of a mission, and the fields that it has `changed`."""
        if mission is self.current:
            changed["elapsed"] = round(self._flight.elapsed(now_ns), 3)
        if "verdict" in changed:
            self.failed += changed["verdict"]["outcome"] == "failure"
        self.book.note(mission, event, text, **changed)

    def tell_link(self, text: str, now_ns: int) -> None:
        """Note in the log of the mission under way that the link has changed; `text` says how."""
        if self.current is not None:
            self.note(self.current, "link_changed", text, now_ns)

    @property
    def _inherits_stop(self) -> MissionRecord | None:
        """Mission that an emergency stop ended before teleop restarted; None without one.

        Only the first telemetry shows whether the robot obeyed this stop. Afterwards, and while
        teleop repeats a stop, the value is None.
        """
        unknown = self.seen is None and not self._teleop.stopping
        return self.book.stopped() if unknown else None

    @property
    def _flight(self) -> MissionFlight:
        flight = self._teleop.flight
        assert flight is not None, "a mission is under way"
        return flight

    def _witness(self, mission: MissionRecord, seen: RobotStatus, now_ns: int) -> None:
        """Note what telemetry shows about contacts, touches and slips in a mission."""
        before, known = self.seen, mission.witness
        time, touched = self._flight.elapsed(now_ns), mission.order.touched
        first = known.first_contact
        if seen.obstacle_contacts and not first:
            first = f"at {time:.2f} s, {describe_point(seen.position)} m"
        mission.witness = replace(
            known,
            obstacle_contacts=seen.obstacle_contacts,
            first_contact=first,
            touch_speed=finite(seen.touch_speed),
            slip_ns=known.slip_ns + (seen.slip_ns - before.slip_ns if before else 0),
        )
        for event, text in mission.witness.news(known, time, touched or ""):
            self.note(mission, event, text, now_ns)

    def _tell_silence(self, now_ns: int) -> None:
        """Note if the mission under way gets no telemetry."""
        mission, view = self.current, self._view
        if mission is None:
            return
        cloud_ns = self._began_ns if view.heard_ns is None else view.heard_ns
        for event, text in self._interruptions.wait(
            self.seen,
            self._flight.elapsed(now_ns),
            (now_ns - max(view.seen_ns, self._began_ns)) * 1e-9,
            cloud_is_silent=(now_ns - cloud_ns) * 1e-9 > SILENCE,
        ):
            self.note(mission, event, text, now_ns)

    def _process_event(self, event: MissionEvent, now_ns: int) -> None:
        mission, flight, seen = self.current, self._flight, self.seen
        assert mission is not None, "an event belongs to a mission"
        changed: dict[str, Any] = {"waypoint": event.waypoint} if event.waypoint >= 0 else {}
        if event.event == "started" and seen is not None:
            changed |= {"world": seen.world, "witness": Observations()}
        if event == flight.outcome and (ending := flight.ending):
            elapsed = flight.elapsed(now_ns)
            evidence = mission.witness.evidence(
                ending,
                elapsed,
                waypoints=len(mission.order.plan.waypoints),
                reached=len(mission.reached),
                wanted=mission.order.touch,
            )
            if ending.code != "done":  # an interruption may be the reason
                told = self._interruptions.failures(elapsed)
                evidence = replace(evidence, violations=(*evidence.violations, *told))
            changed["verdict"] = judge(evidence).as_json()
        self.note(mission, event.event, event.text, now_ns, **changed)
        if mission.ended:
            self.current = None
