"""Queue and fly missions, carry out the operator's commands, and report the robot's state.

A new teleop process continues the mission of the earlier process at the same waypoint, unless world
has restarted. If an emergency stop has not reached the robot, the new process sends it again.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import replace
from math import hypot, inf
from typing import Any

import numpy as np

from cloudrc.errors import BadInputError
from cloudrc.geometry.clearance import NO_SIZE, Hull, clearance_per_obstacle
from cloudrc.geometry.fence import Fence
from cloudrc.geometry.obstacles import obstacles, surface
from cloudrc.geometry.placement import find_crossed
from cloudrc.geometry.scene import Scene
from cloudrc.messages import GuardState, Setpoint, Start, Vector
from cloudrc.metrics.verdict import (
    Ending,
    FlightFailure,
    FlightVerdict,
    Observations,
    finite_or_none,
    judge,
)
from cloudrc.records import BY_HAND, Fault, MissionEvent
from cloudrc.teleop.carrot import HEARTBEAT_NS, SPEED_MAX
from cloudrc.teleop.interruptions import SILENCE, Interruptions
from cloudrc.teleop.mission import Teleop
from cloudrc.teleop.store import ConflictError, MissionRecord, MissionStore, Order, UnavailableError
from cloudrc.teleop.wire import FLYING, HELD, QUEUED, Leg, Output, Plan, RobotStatus

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
LATCHED, AIRBORNE = (LAND, ESTOP), (TRACK, HOLD, LAND)
"""States of the guard that only an acknowledgement ends; states in which the robot may move."""
SETPOINT_PERIOD_NS = 100_000_000
"""Time between two copies of the setpoint [ns]; a cloud that restarts needs the copies."""
DRIVE_LIMIT = 3600.0
"""Time limit of a mission that begins with a request to drive [s]."""
QUEUE_MAX = 16
"""Largest number of missions that wait while another mission flies."""
STEERED = ("held", *BY_HAND)
"""Events of a held mission that tell who steers the robot."""
DRIVEN = "driven"
"""State for `next_step` while the operator drives the robot by hand during a held mission."""
STARTS = "a velocity other than zero makes the robot start, once telemetry has arrived"
CANCELLED, BEFORE, ASKED = "mission cancelled", " before it began", "the robot is asked to start"
RESTARTED = "teleop has restarted; the robot is asked to go on"
REST = "after a stop or a landing only when it has stood still, well inside the fence"
BY_ITSELF = "without commands the robot holds its position, then goes to LAND, by itself"
NOT_HEARD = f"cloud has no telemetry from the robot: check the link and world; {BY_ITSELF}"
NO_CLOUD = f"teleop does not hear cloud, so there is no telemetry: check cloud; {BY_ITSELF}"
STOP_IS_SENT = "an emergency stop is on its way to the robot"
ALONE = {
    GROUND: f"the robot waits for a mission; it starts, {REST}",
    TRACK: "teleop is telling the robot that its mission is over; then the robot holds",
    HOLD: "the robot holds and waits for a mission",
    LAND: "the robot comes to rest and switches off; find the cause, then: cloudrc mission "
    "acknowledge",
    ESTOP: "the robot is switched off; find the cause, then: cloudrc mission acknowledge",
}
"""State of the guard -> what happens next, while no mission is under way."""
IN_MISSION = {
    **ALONE,
    GROUND: f"the robot starts with the mission's first commands, {REST}; if no command comes "
    "within guard.hold_max_s (at least 10 s), the guard goes to LAND",
    TRACK: "the robot follows its mission",
    HOLD: "the robot gets no fresh commands: it continues by itself when they arrive, and goes to "
    "LAND if none arrive within guard.hold_max_s",
}
"""State of the guard -> what happens next, while a mission is under way."""


def next_step(guard: GuardState, age: float, cloud_age: float, mission: str | None) -> str:
    """Describe what the robot does next, or what the operator has to do.

    `age` is the age of the telemetry [s], `cloud_age` the age of the last message from cloud [s].
    `mission` is the state of the mission under way: `DRIVEN` while the operator steers the robot by
    hand, None if no mission is under way.
    """
    if age > SILENCE:
        return NO_CLOUD if cloud_age > SILENCE else NOT_HEARD
    if mission == DRIVEN and guard is TRACK:
        return "the operator drives; to end the drive: cloudrc mission resume, or cancel"
    if mission == HELD and guard is TRACK:
        return "the operator holds the mission; to continue: cloudrc mission resume, or cancel"
    return (ALONE if mission is None else IN_MISSION)[guard]


class MissionService:
    """Stores and flies all missions of one robot, one after the other.

    All times `now_ns` are on this process's monotonic clock [ns]. The methods for the operator's
    commands raise ConflictError if the state of mission or robot forbids the command. They raise
    UnavailableError if the disk refuses the mission, or if this process ends.
    """

    def __init__(
        self,
        book: MissionStore,
        fence: Fence,
        scene: Scene | None = None,
        hull: Hull = NO_SIZE,
        units: Mapping[str, str] | None = None,
        *,
        speed_max: float = SPEED_MAX,
    ) -> None:
        """Begin with the missions in the store `book`, in a scene with `fence`.

        With a `scene`, the service refuses straight ways of the robot's `hull` through obstacles.
        `units` are the names of the robot's own sensors, in the order of telemetry, and their units
        (None: no sensors). `speed_max` is the guard's speed limit [m/s]: a drive by hand is not
        faster, and never faster than `SPEED_MAX`.
        """
        self._drive_max = min(speed_max, SPEED_MAX)
        self._units = tuple((units or {}).items())
        self._scene, self._hull = scene, hull
        self._outputs: list[Output | Fault] = []
        self.book, self._teleop, self._fence = book, Teleop(fence, book.has_ended), fence
        self._heard_ns: int | None = None  # when the last message from cloud arrived
        self._seen_ns = self._guard_ns = 0  # times of telemetry and of the guard's last change
        self._setpoint: Setpoint | None = None
        self._setpoint_ns = 0
        self._current: MissionRecord | None = None
        self._began_ns = 0  # when this process began to fly the present mission
        self._interruptions = Interruptions()  # of the present mission
        self._ends = False  # whether this process ends; the next process flies the queue
        self._trouble = ""  # trouble of the store that was last reported
        self._driven_ns = -HEARTBEAT_NS  # time of the last request to drive
        self._renewed_ns: dict[str, int] = {}  # mission's id -> time of its watcher's last word
        self._interrupted = False  # whether a drive has to pause (let go) before it continues

    @property
    def seen(self) -> RobotStatus | None:
        """The newest telemetry; None before the first telemetry."""
        return self._teleop.seen

    @property
    def over(self) -> bool:
        """Whether missions exist, all have ended, and no request is left to carry out."""
        return bool(self.book.missions) and not self.book.open() and self.settled

    @property
    def settled(self) -> bool:
        """Whether telemetry shows that the robot has acted on the last request."""
        return self._teleop.settled

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
        if len(waiting) > QUEUE_MAX:
            raise ConflictError(f"{QUEUE_MAX} missions wait already; cancel one", waiting[0].id)
        self._check_can_fly()
        if order.plan.start is Start.HERE and not waiting and not order.plan.by_hand:
            self._check_way(order.plan.legs[0], touch=order.touched)
        mission = self.book.add(order)
        self._renewed_ns[mission.id] = now_ns
        if waiting:
            self._note(mission, "queued", f"mission waits for {waiting[-1].id}", now_ns)
        else:
            self._start_next(now_ns, queued=True)
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
        if not mission.ended and mission is self._start_next(now_ns):
            return self._operate(lambda now: self._teleop.cancel(now, CANCELLED + why), now_ns)
        if mission.ended:  # maybe just now, because world has restarted
            raise ConflictError(f"mission {mission.id} has ended: {mission.state}", mission.id)
        text = CANCELLED + BEFORE + why
        verdict = FlightVerdict("interrupted", (FlightFailure("cancelled", text),)).as_json()
        self._note(mission, "cancelled", text, now_ns, verdict=verdict)
        if self.book.trouble:
            text = f"{mission.id} is cancelled, but waits again if teleop restarts"
            raise UnavailableError(f"{text}: {self.book.trouble}")
        return mission

    def hold(self, now_ns: int) -> MissionRecord:
        """Interrupt the mission under way: the robot holds its position."""
        self._interrupted = True
        return self._operate(self._teleop.hold, now_ns)

    def resume(self, now_ns: int) -> MissionRecord:
        """Continue the held mission, straight to the next waypoint."""
        self._check_can_fly()
        if (mission := self._current) is not None and mission.state == HELD:
            leg = mission.order.plan.legs[mission.waypoint]
            self._check_way(leg, touch=mission.order.touched)
        return self._operate(self._teleop.resume, now_ns)

    def go_to(self, leg: Leg, now_ns: int) -> MissionRecord:
        """Fly straight to a point, during a held mission or as a new mission."""
        self._check_can_fly()
        waiting = self.book.open()
        if not waiting:
            plan = Plan((leg,), Start.HERE, leg.time_limit)
            return self.create(Order(plan, "goto"), now_ns)[0]
        if waiting[0].state != HELD:
            raise _busy(waiting[0], "hold or cancel it first")
        self._check_way(leg, touch=waiting[0].order.touched)
        return self._operate(lambda now: self._teleop.go_to(now, leg), now_ns)

    def drive(self, velocity: Vector, now_ns: int) -> MissionRecord:
        """Drive the setpoint with `velocity` [m/s], in a held mission or in a new one.

        The setpoint brakes and rests if the next request comes later than `HEARTBEAT_NS`. After a
        hold, a stop or the end of a mission, the operator can drive on only after a request for
        zero velocity, or after a pause of `HEARTBEAT_NS`.
        """
        pause_ns, self._driven_ns = now_ns - self._driven_ns, now_ns
        x, y, z = velocity
        scale = self._drive_max / max(hypot(x, y, z), self._drive_max)
        velocity = (scale * x, scale * y, scale * z)
        rests = not any(velocity)
        self._interrupted = self._interrupted and not rests and pause_ns <= HEARTBEAT_NS
        self._check_can_fly()
        waiting, seen = self.book.open(), self.seen
        if self._interrupted:
            raise ConflictError("a hold, a stop or an end came in between; let go, then drive on")
        if not waiting:
            if seen is None or rests:
                raise ConflictError(f"no mission is under way; {STARTS}")
            x, y, z = seen.position
            leg = Leg((x, y, max(z, self._fence.inner_low[2])), tolerance=inf, dwell=0.0)
            plan = Plan((leg,), Start.HERE, DRIVE_LIMIT, by_hand=True)
            self.create(Order(plan, "drive"), now_ns)
        elif waiting[0].state != HELD and not waiting[0].order.plan.by_hand:
            raise _busy(waiting[0], "hold or cancel it first")
        return self._operate(lambda now: self._teleop.drive(now, velocity), now_ns)

    def switch_off(self, now_ns: int) -> MissionRecord | None:
        """Switch the robot off at once, in any state; return the mission that this ends, if any."""
        self._interrupted = True
        mission = self._start_next(now_ns)
        self._teleop.stop(now_ns)
        self._collect(now_ns)
        return mission

    def acknowledge(self, now_ns: int) -> None:
        """Let the robot fly again after a landing or a stop, if no mission is under way.

        Raise a ConflictError while a stop is repeated: the next copy would stop the robot again.
        """
        if self._current is not None:
            raise _busy(self._current, "there is nothing to acknowledge")
        if self._stop_is_sent:
            text = "acknowledge again once 'cloudrc mission status' shows ESTOP"
            raise ConflictError(f"{STOP_IS_SENT}; {text}")
        self._interrupted = True
        self._teleop.acknowledge(now_ns)
        self._collect(now_ns)

    def pause(self, now_ns: int) -> None:
        """Pause the mission under way because this process ends; the next process continues it."""
        self._ends = True
        if self._start_next(now_ns) is not None:
            self._operate(self._teleop.pause, now_ns)

    def hear(self, now_ns: int) -> None:
        """Record that a message from cloud has arrived at `now_ns`."""
        self._heard_ns = now_ns

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Process telemetry that has arrived at `now_ns`."""
        before, mission = self.seen, self._current
        if self._inherits_stop and seen.mission_id == self._inherits_stop.number:
            if seen.guard in AIRBORNE:  # the stop has not reached the robot
                self._teleop.stop(now_ns)
        self._heard_ns = self._seen_ns = now_ns
        if before is None or (before.world, before.guard) != (seen.world, seen.guard):
            self._guard_ns = now_ns
        if mission is not None and (mission.number, mission.world) == (seen.mission_id, seen.world):
            self._witness(mission, seen, now_ns)
            if before is not None and before.epoch != seen.epoch:
                text = f"cloud has a new session; the mission is {mission.state}"
                self._note(mission, "new_session", f"{text} {self._teleop.where}", now_ns)
        if mission is not None:
            time, flies = self._teleop.elapsed(now_ns), mission.state in (FLYING, HELD)
            for event, text in self._interruptions.see(seen, time, flies=flies):
                self._note(mission, event, text, now_ns)
        self._teleop.see(seen, now_ns)
        self._collect(now_ns)

    def _witness(self, mission: MissionRecord, seen: RobotStatus, now_ns: int) -> None:
        """Note what telemetry shows about contacts, touches and slips in a mission."""
        before, known = self.seen, mission.witness
        mission.witness = replace(
            known,
            obstacle_contacts=seen.obstacle_contacts,
            first_contact=known.first_contact or self._describe_contact(seen, now_ns),
            touch_speed=finite_or_none(seen.touch_speed),
            slip_ns=known.slip_ns + (seen.slip_ns - before.slip_ns if before else 0),
        )
        time, touch = self._teleop.elapsed(now_ns), mission.order.touch
        for event, text in mission.witness.news(known, time, touch.body if touch else ""):
            self._note(mission, event, text, now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Start a waiting mission, check time limits, and repeat the messages that are due."""
        self.book.catch_up(now_ns)
        if not self._ends:
            self._cancel_unwatched(now_ns)
            blocked = self.seen is None or self.book.trouble or self._blocked
            self._start_next(now_ns, queued=not blocked)
        self._tell_silence(now_ns)
        self._teleop.handle_deadline(now_ns)
        self._collect(now_ns)
        if self._setpoint is not None and now_ns >= self._setpoint_ns:
            self._setpoint_ns = now_ns + SETPOINT_PERIOD_NS
            self._outputs.append(self._setpoint)

    def take_outputs(self) -> list[Output | Fault]:
        """Return the messages for cloud and the faults for teleop's log, oldest first."""
        outputs, self._outputs = self._outputs, []
        return outputs

    def state(self, now_ns: int) -> dict[str, Any]:
        """Return the state of missions and robot in the form of the API's `StateView`."""
        mission, heard_ns = self._current, self._heard_ns
        cloud_age = None if heard_ns is None else (now_ns - heard_ns) * 1e-9
        return {
            "mission": mission.summary() if mission is not None else None,
            "queue": [waits.id for waits in self.book.open() if waits is not mission],
            "cloud_age_s": cloud_age,
            "seen": None if cloud_age is None else self._seen_view(now_ns, cloud_age),
        }

    def _seen_view(self, now_ns: int, cloud_age: float) -> dict[str, Any] | None:
        """Return what telemetry shows, as the API's `SeenView`; None before the first telemetry.

        `cloud_age` is the age of cloud's last message [s].
        """
        if (seen := self.seen) is None:
            return None
        age, control = (now_ns - self._seen_ns) * 1e-9, seen.control
        return {
            "age_s": age,
            "epoch": seen.epoch,
            "world": seen.world,
            "position_m": [finite_or_none(value) for value in seen.position],
            "guard": seen.guard.name,
            "cause": seen.cause.words,
            "guard_for_s": (now_ns - self._guard_ns) * 1e-9 if age <= SILENCE else None,
            "next_step": next_step(seen.guard, age, cloud_age, self._steered_state(now_ns)),
            "obstacle_contacts": seen.obstacle_contacts,
            "touch_speed_mps": finite_or_none(seen.touch_speed),
            "sensors": self._sensors(seen),
            "horizon_s": control and finite_or_none(control.horizon),
            "rtt_s": control and finite_or_none(control.rtt),
            "loop_delay_s": control and finite_or_none(control.loop_delay),
        }

    def _steered_state(self, now_ns: int) -> str | None:
        """Return the state of the mission under way; DRIVEN while somebody drives the robot."""
        mission = self._current
        if mission is None or mission.state != HELD:
            return mission.state if mission else None
        by_hand = (e["event"] for e in reversed(mission.events) if e["event"] in STEERED)
        last, pause_ns = next(by_hand, ""), now_ns - self._driven_ns
        back = last == "operator_lost" and pause_ns <= HEARTBEAT_NS
        return DRIVEN if last == "driving" or back else HELD

    def _sensors(self, seen: RobotStatus) -> list[dict[str, Any]]:
        """Return the robot's own sensors; none if world's robot.yaml is another one."""
        if len(seen.sensors) != len(self._units):
            return []
        return [
            {"name": name, "value": finite_or_none(value), "unit": unit}
            for (name, unit), value in zip(self._units, seen.sensors, strict=True)
        ]

    @property
    def _inherits_stop(self) -> MissionRecord | None:
        """Mission that an emergency stop ended before teleop restarted; None without one.

        Only the first telemetry shows whether the robot obeyed this stop. Afterwards, and while
        teleop repeats a stop, the value is None.
        """
        unknown = self.seen is None and not self._teleop.stopping
        return self.book.stopped() if unknown else None

    @property
    def _stop_is_sent(self) -> bool:
        """Whether telemetry does not show yet that the robot has obeyed an emergency stop."""
        return self._teleop.stopping or self._inherits_stop is not None

    @property
    def _blocked(self) -> str:
        """Why the robot cannot fly until the operator's acknowledgement; "" if it can fly."""
        if self._stop_is_sent:
            return STOP_IS_SENT
        seen = self.seen
        if seen is None or seen.guard not in LATCHED:
            return ""
        return f"the guard is in {seen.guard.name} ({seen.cause.words}) and lets nothing fly"

    def _check_can_fly(self) -> None:
        if self._ends:
            raise UnavailableError("teleop ends; repeat this when teleop runs again")
        if self._blocked:
            raise ConflictError(
                f"{self._blocked}; find the cause, then: cloudrc mission acknowledge"
            )

    def _describe_contact(self, seen: RobotStatus, now_ns: int) -> str:
        """Describe in words where the robot touches an obstacle; "" if it has touched none.

        Telemetry counts contacts, but does not name the bodies. The text names the nearest one.
        """
        mission, scene = self._current, self._scene
        if not seen.obstacle_contacts or mission is None:
            return ""
        text = f"at {self._teleop.elapsed(now_ns):.2f} s, {_place(seen.position)} m"
        known = () if scene is None else obstacles(scene, touch=mission.order.touched)
        if not known:
            return text
        away = clearance_per_obstacle(
            known, [seen.position], [seen.orientation_wxyz], self._hull.few
        )[0]
        return f"{text}, next to {known[away.argmin()].name}"

    def _check_way(self, leg: Leg, *, touch: str | None) -> None:
        """Raise ConflictError if an obstacle lies between the robot and the waypoint of `leg`.

        The body `touch`, which the mission has to touch, is none.
        """
        seen, scene = self.seen, self._scene
        if seen is None or scene is None:
            return
        here, there = np.array([seen.position]), np.array([leg.position])
        known = obstacles(scene, touch=touch)
        through = int(find_crossed(known, self._hull.dense, here, there, leg.yaw or 0.0)[0])
        if through >= 0:
            raise ConflictError(
                f"the straight way from where the robot is, {_place(seen.position)}, to "
                f"{_place(leg.position)} leads through {surface(known[through])}; "
                "go round it first, by another target",
                self._current.id if self._current else "",
            )

    def _operate(self, verb: Callable[[int], None], now_ns: int) -> MissionRecord:
        mission = self._current
        if mission is None:
            raise ConflictError("no mission is under way")
        try:
            verb(now_ns)
        except BadInputError as error:
            raise ConflictError(str(error), mission.id) from None
        self._collect(now_ns)
        return mission

    def _start_next(self, now_ns: int, *, queued: bool = False) -> MissionRecord | None:
        """If no mission is under way, start the oldest mission that has not ended.

        If an earlier teleop process has started that mission, continue it. If it is queued, start
        it only if `queued` is True, and only after its new state is on the disk. Return the mission
        that is under way after this call, or None.
        """
        waiting = self.book.open()
        if self._current is not None or not waiting:
            return self._current
        mission = waiting[0]
        if queued and mission.state == QUEUED:
            self._note(mission, "starting", ASKED, now_ns)
        if mission.world or (mission.state != QUEUED and not self.book.trouble):
            self._current, self._began_ns = mission, now_ns
            self._interruptions = Interruptions()
            self._teleop.start(now_ns, mission)
            if mission.world:  # an earlier teleop has begun it
                self._note(mission, "restarted", RESTARTED, now_ns)
        self._collect(now_ns)
        return self._current

    def _collect(self, now_ns: int) -> None:
        for output in self._teleop.take_outputs():
            if isinstance(output, Setpoint):
                self._setpoint, self._setpoint_ns = output, now_ns + SETPOINT_PERIOD_NS
            elif isinstance(output, MissionEvent):
                self._process_event(output, now_ns)
            self._outputs.append(output)
        told, self._trouble = self._trouble, self.book.trouble
        if self._trouble not in ("", told):
            self._outputs.append(Fault(now_ns, "journal", self._trouble))

    def tell_link(self, text: str, now_ns: int) -> None:
        """Note in the log of the mission under way that the link has changed; `text` says how."""
        if self._current is not None:
            self._note(self._current, "link_changed", text, now_ns)

    def _tell_silence(self, now_ns: int) -> None:
        """Note if the mission under way gets no telemetry."""
        if (mission := self._current) is None:
            return
        cloud_ns = self._began_ns if self._heard_ns is None else self._heard_ns
        for event, text in self._interruptions.wait(
            self.seen,
            self._teleop.elapsed(now_ns),
            (now_ns - max(self._seen_ns, self._began_ns)) * 1e-9,
            cloud_is_silent=(now_ns - cloud_ns) * 1e-9 > SILENCE,
        ):
            self._note(mission, event, text, now_ns)

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

    def _process_event(self, event: MissionEvent, now_ns: int) -> None:
        mission, seen = self._current, self.seen
        assert mission is not None, "an event belongs to a mission"
        changed: dict[str, Any] = {"waypoint": event.waypoint} if event.waypoint >= 0 else {}
        if event.event == "started" and seen is not None:
            changed |= {"world": seen.world, "witness": Observations()}
        if event == self._teleop.outcome:
            evidence = mission.witness.evidence(
                Ending(event.event, event.text),
                self._teleop.elapsed(now_ns),
                waypoints=len(mission.order.plan.waypoints),
                reached=len(mission.reached),
                wanted=mission.order.touch,
            )
            if event.event != "done":  # an interruption may be the reason
                told = self._interruptions.failures(self._teleop.elapsed(now_ns))
                evidence = replace(evidence, violations=(*evidence.violations, *told))
            changed["verdict"] = judge(evidence).as_json()
        self._note(mission, event.event, event.text, now_ns, **changed)
        if mission.ended:
            self._current, self._interrupted = None, True

    def _note(
        self, mission: MissionRecord, event: str, text: str, now_ns: int, **changed: Any
    ) -> None:
        if mission is self._current:
            changed["elapsed"] = round(self._teleop.elapsed(now_ns), 3)
        self.book.note(mission, event, text, **changed)


def _busy(mission: MissionRecord, advice: str) -> ConflictError:
    return ConflictError(f"mission {mission.id} is {mission.state}; {advice}", mission.id)


def _place(position: Vector) -> str:
    return f"[{', '.join(f'{value:.2f}' for value in position)}]"
