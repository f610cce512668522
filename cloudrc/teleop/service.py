"""Missions as a service: orders, verbs and the robot as seen come in; answers and events go out.

Pure, like the machine that it drives, and keeping a book of what it does. Missions have an id of
ours and, if their sender wishes, a key of theirs: a second order under the same key is answered
with the mission that the first one made. A mission that was under way when the book was closed
goes on at the same waypoint, if the world is still the one in which it began.

The operator's emergency stop over the lives of teleop: it is asked for until it is acknowledged.

That a mission was stopped stands in the book, and so does the acknowledgement once the robot is
seen to have acted on it. A teleop that finds the one without the other asks again, for the robot
may not have heard of it; unless that robot has flown something else since, or is another one.

The robot as teleop sees it: telemetry comes in; its state, since when and what is next go out.

What comes next follows from state and mission.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import asdict
from math import isfinite
from typing import Any

from cloudrc.errors import BadInputError
from cloudrc.messages import GuardState, Setpoint, Start, Vector
from cloudrc.records import Fault, MissionEvent
from cloudrc.teleop import store as missions
from cloudrc.teleop.journal import Entry
from cloudrc.teleop.mission import Teleop
from cloudrc.teleop.store import ConflictError, Mission, MissionBook, Order, UnavailableError, busy
from cloudrc.teleop.verdict import Witness
from cloudrc.teleop.wire import (
    Acknowledge,
    Cancel,
    Continue,
    EmergencyStop,
    GoTo,
    Hold,
    Leg,
    Output,
    Pause,
    Plan,
    Resume,
    Seen,
    StartMission,
    Verb,
)


class Stop:
    """Asks for it, and knows what it has stopped."""

    def __init__(self, book: MissionBook, teleop: Teleop) -> None:
        """Ask again for what a teleop before this one has asked for."""
        self._book, self._teleop = book, teleop
        self._is_released = False
        self._is_inherited = book.stopped() is not None  # and nobody has asked this process
        if self._is_inherited:
            teleop.operate(EmergencyStop(), 0)

    @property
    def is_asked(self) -> bool:
        """Whether the robot has not been seen to have stopped yet."""
        return self._teleop.requests.stopping

    def ask(self, now_ns: int) -> None:
        """Stop the rotors at once."""
        self._is_released = self._is_inherited = False
        self._teleop.operate(EmergencyStop(), now_ns)

    def release(self, now_ns: int) -> None:
        """The operator acknowledges it; the robot is told once it has stopped."""
        self._teleop.operate(Acknowledge(), now_ns)
        self._is_released = True

    def meet(self, seen: Seen) -> None:
        """Take the first look at the robot, before teleop does."""
        stopped = self._book.stopped()
        if self._is_inherited and stopped is not None and seen.mission_id != stopped.number:
            self._teleop.requests.withdraw_stop()

    def released(self) -> Mission | None:
        """Give the mission whose stop the robot is seen to be released from, once."""
        if not self._is_released or not self._teleop.settled:
            return None
        self._is_released = False
        return self._book.stopped()


GROUND, TRACK, HOLD, LAND, ESTOP = GuardState
LATCHED = (LAND, ESTOP)
"""States of the guard that only the operator's acknowledgement leads out of."""
SILENCE = 1.0
"""Telemetry that is older tells no more how the robot is, nor a word of cloud that it lives [s]."""
REST = "after a stop or a touch-down only once it has been still, 0.5 m inside the fence"
BY_ITSELF = "without commands the robot holds where it flies, then lands, by itself"
NOT_HEARD = f"the robot is not heard, though cloud is: look at the link and at world; {BY_ITSELF}"
NO_CLOUD = f"cloud is not heard, and so the robot is not: look at cloud's process; {BY_ITSELF}"
ALONE = {
    GROUND: f"the robot waits for a mission; it takes off, {REST}",
    TRACK: "the robot is being told that its mission is over, and holds then",
    HOLD: "the robot holds and waits for a mission",
    LAND: "the robot lands; see why, then: cloudrc mission acknowledge",
    ESTOP: "the rotors are stopped; see why, then: cloudrc mission acknowledge",
}
"""What comes next while no mission is under way, by the guard's state."""
IN_MISSION = {
    **ALONE,
    GROUND: f"the robot takes off with the mission's first commands, {REST}; without them for long "
    "(guard.hold_max_s, 10 s at least) it is in LAND as it stands",
    TRACK: "the robot flies its mission",
    HOLD: "no fresh commands reach the robot: it goes on by itself as soon as they do, and lands "
    "if they do not for long (guard.hold_max_s)",
}
HELD = "the operator holds the mission; to go on: cloudrc mission resume"


class Sight:
    """The newest telemetry.

    Attributes:
        seen: What it says; None until the robot has been seen.
    """

    def __init__(self) -> None:
        self.seen: Seen | None = None
        self._seen_ns = self._guard_ns = 0
        self._heard_ns: int | None = None

    @property
    def guard(self) -> GuardState:
        """State of the guard; GROUND until it has been seen."""
        return GROUND if self.seen is None else self.seen.guard

    @property
    def latched(self) -> str:
        """Why the guard lets nothing fly before it is acknowledged; "" if it does."""
        guard = self.guard
        if self.seen is None or guard not in LATCHED:
            return ""
        return f"the guard is in {guard.name} ({self.seen.cause.words}) and lets nothing fly"

    def hear(self, now_ns: int) -> None:
        """Take note that cloud lives, whether it has telemetry or not [ns]."""
        self._heard_ns = now_ns

    def cloud_age(self, now_ns: int) -> float | None:
        """Say how long cloud has not been heard [s]; None if it never was.

        Args:
            now_ns: Own clock [ns].
        """
        return None if self._heard_ns is None else (now_ns - self._heard_ns) * 1e-9

    def see(self, seen: Seen, now_ns: int) -> bool:
        """Take note of telemetry as it arrives [ns].

        Returns:
            Whether the same robot is seen in another session than before.
        """
        before, self.seen, self._seen_ns = self.seen, seen, now_ns
        self.hear(now_ns)
        if before is None or before.world != seen.world:
            self._guard_ns = now_ns
            return False
        if before.guard is not seen.guard:
            self._guard_ns = now_ns
        return before.epoch != seen.epoch

    def show(self, now_ns: int, mission: str | None) -> dict[str, Any] | None:
        """Say how the robot is, as the API shows it; None if it has not been seen.

        Args:
            now_ns: Own clock [ns].
            mission: State of the one under way, in a word; None if there is none.
        """
        seen, age, cloud_age = self.seen, (now_ns - self._seen_ns) * 1e-9, self.cloud_age(now_ns)
        if seen is None or cloud_age is None:
            return None
        return {
            "age_s": age,
            "epoch": seen.epoch,
            "world": seen.world,
            "position_m": [_known(value) for value in seen.position],
            "guard": seen.guard.name,
            "cause": seen.cause.words,
            "guard_for_s": (now_ns - self._guard_ns) * 1e-9 if age <= SILENCE else None,
            "next_step": next_step(seen.guard, age, cloud_age, mission),
            "pipe_contacts": seen.pipe_contacts,
            "touch_speed_mps": _known(seen.touch_speed),
            "horizon_s": _known(seen.horizon),
            "rtt_s": _known(seen.rtt),
            "loop_delay_s": _known(seen.loop_delay),
        }


def next_step(guard: GuardState, age: float, cloud_age: float, mission: str | None) -> str:
    """Say what comes next, or what the operator has to do for it.

    Args:
        guard: State of the guard.
        age: Of the telemetry that says so [s].
        cloud_age: How long cloud has not been heard [s], which tells of telemetry.
        mission: State of the one under way, in a word; None if there is none.
    """
    if age > SILENCE:
        return NO_CLOUD if cloud_age > SILENCE else NOT_HEARD
    if mission == "held" and guard is TRACK:
        return HELD
    return (ALONE if mission is None else IN_MISSION)[guard]


def _known(value: float) -> float | None:
    """JSON knows no NaN."""
    return value if isfinite(value) else None


SETPOINT_PERIOD_NS = 100_000_000
"""Time between two copies of the setpoint [ns], so that either process may restart."""


class MissionService:
    """All missions of one robot, flown one after the other."""

    def __init__(
        self,
        contact_speed_max: float,
        write: Callable[[Entry], None] = lambda entry: None,
        entries: Iterable[Entry] = (),
        *,
        salt: bytes,
    ) -> None:
        """Remember what was before; nothing is flown until the first deadline.

        Args:
            contact_speed_max: Below which the arm's tip may meet the board [m/s].
            write: Keeps an entry; raises OSError if it cannot.
            entries: What was kept before, oldest first.
            salt: Random, so that the robot never takes a mission for one of another journal.
        """
        self._contact_speed_max = contact_speed_max
        self._outputs: list[Output | Fault] = []
        self.sight = Sight()
        self._setpoint: Setpoint | None = None
        self._setpoint_ns = 0
        self._current: Mission | None = None
        self._ends = False  # this process; what has not begun is its successor's
        self.book = MissionBook(write, entries, salt)
        self._teleop = Teleop(self.book.has_ended)
        self._stop = Stop(self.book, self._teleop)

    @property
    def over(self) -> bool:
        """Whether there was something to fly, all of it has ended, and the robot holds."""
        return bool(self.book.missions) and not self.book.open() and self._teleop.settled

    def create(self, order: Order, now_ns: int) -> tuple[Mission, bool]:
        """Take an order; it is started at once or waits.

        Returns:
            The mission, and whether it is new: the same key gives the same mission.

        Raises:
            ConflictError: If another one is under way and the order does not want to wait, or too
                many do, or the operator has to acknowledge first.
            UnavailableError: If it cannot be kept, or this process ends.
        """
        known = self.book.with_key(order.key)
        if known is not None:
            return known, False
        waiting = self.book.waits_for(order)
        self._refuse_to_fly()
        mission = self.book.add(order)
        if waiting:
            self._note(mission, "queued", f"mission waits for {waiting[-1].id}", now_ns)
        else:
            self._launch(mission, StartMission(order.plan, mission.number), now_ns)
        return mission, True

    def cancel(self, mission_id: str, now_ns: int) -> Mission:
        """End a mission, or take it out of the queue.

        Raises:
            UnknownMissionError: If there is none of this id.
            ConflictError: If it has ended.
            UnavailableError: If it has not begun, and that it will not cannot be kept.
        """
        mission = self.book.find(mission_id)
        if not mission.ended and mission is self._take_up(now_ns):
            return self._operate(Cancel(), now_ns)
        if mission.ended:  # perhaps as it was taken up: in another world
            raise ConflictError(f"mission {mission.id} has ended: {mission.state}", mission.id)
        self.book.cancel(mission)
        return mission

    def hold(self, now_ns: int) -> Mission:
        """Stop the robot where it is; raises ConflictError unless it flies a mission."""
        return self._operate(Hold(), now_ns)

    def resume(self, now_ns: int) -> Mission:
        """Go on with what is held; raises ConflictError, or UnavailableError at the end."""
        self._refuse_to_fly()
        return self._operate(Resume(), now_ns)

    def go_to(self, position: Vector, yaw: float, now_ns: int) -> Mission:
        """Fly to a point: a mission of its own, or another place to be held at.

        Args:
            position: [m], world frame, shape (3,).
            yaw: [rad].
            now_ns: Own clock [ns].

        Raises:
            ConflictError: If a mission is under way that is not held.
            UnavailableError: If it cannot be kept, or this process ends.
        """
        self._refuse_to_fly()
        waiting = self.book.open()
        if waiting and waiting[0].state != missions.HELD:
            raise busy(waiting[0], "hold or cancel it first")
        if waiting:
            return self._operate(GoTo(position, yaw), now_ns)
        leg = Leg(position, yaw)
        mission = self.book.add(Order(Plan((leg,), Start.HERE, leg.time_limit), "goto"))
        self._launch(mission, GoTo(position, yaw, mission.number), now_ns)
        return mission

    def stop_rotors(self, now_ns: int) -> Mission | None:
        """Stop the rotors at once, in every state; give the mission under way, which has failed."""
        mission = self._take_up(now_ns)
        self._stop.ask(now_ns)
        self._collect(now_ns)
        return mission

    def acknowledge(self, now_ns: int) -> None:
        """Release a robot that has landed or was stopped; raises ConflictError in a mission."""
        if self._current is not None:
            raise busy(self._current, "there is nothing to acknowledge")
        self._stop.release(now_ns)
        self._collect(now_ns)

    def pause(self, now_ns: int) -> None:
        """Before this process ends: what is flown is held, for a successor to go on with."""
        self._ends = True
        if self._take_up(now_ns) is not None:
            self._operate(Pause(), now_ns)

    @property
    def settled(self) -> bool:
        """Whether the robot is seen to have acted on the last request."""
        return self._teleop.settled

    def hear(self, now_ns: int) -> None:
        """Take note that cloud lives."""
        self.sight.hear(now_ns)

    def see(self, seen: Seen, now_ns: int) -> None:
        """Take note of the newest telemetry."""
        mission = self._current
        if self.sight.seen is None:
            self._stop.meet(seen)
        anew = self.sight.see(seen, now_ns)
        if mission is not None and mission.world and mission.world == seen.world:
            self._watch(mission, seen, now_ns)
            if anew:
                self._note(mission, "new_session", mission.in_new_session(), now_ns)
        self._teleop.see(seen, now_ns)
        if (stopped := self._stop.released()) is not None:
            self._note(stopped, "acknowledged", "the operator has acknowledged the stop", now_ns)
        self._collect(now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Start what waits, keep the limits of time, repeat what has to be repeated."""
        self.book.catch_up(now_ns)
        if not self._ends:
            in_sight = self.sight.seen is not None
            self._take_up(now_ns, queued=in_sight and self.book.kept and not self._stopped)
        self._teleop.handle_deadline(now_ns)
        self._collect(now_ns)
        if self._setpoint is not None and now_ns >= self._setpoint_ns:
            self._setpoint_ns = now_ns + SETPOINT_PERIOD_NS
            self._outputs.append(self._setpoint)

    def take_outputs(self) -> list[Output | Fault]:
        """Hand over what is to be told, oldest first; faults are for this process' own log."""
        outputs, self._outputs = self._outputs, []
        return outputs

    def state(self, now_ns: int) -> dict[str, Any]:
        """Say how things are, as the API shows it."""
        mission = self._current
        return {
            "mission": mission.summary() if mission is not None else None,
            "queue": [waits.id for waits in self.book.open() if waits is not mission],
            "cloud_age_s": self.sight.cloud_age(now_ns),
            "seen": self.sight.show(now_ns, None if mission is None else mission.state),
        }

    @property
    def _stopped(self) -> str:
        """Why nothing can fly before the operator acknowledges it; "" if it can."""
        if self._stop.is_asked:
            return "an emergency stop is on its way to the robot"
        return self.sight.latched

    def _refuse_to_fly(self) -> None:
        if self._ends:  # the robot is asked to hold
            raise UnavailableError("teleop ends; say it again to the next one")
        if self._stopped:
            raise ConflictError(f"{self._stopped}; see why, then: cloudrc mission acknowledge")

    def _operate(self, verb: Verb, now_ns: int) -> Mission:
        mission = self._current
        if mission is None:
            raise ConflictError("no mission is under way")
        try:
            self._teleop.operate(verb, now_ns)
        except BadInputError as error:
            raise ConflictError(str(error), mission.id) from None
        self._collect(now_ns)
        return mission

    def _take_up(self, now_ns: int, *, queued: bool = False) -> Mission | None:
        """Go on with what was begun before, or begin what is `queued`; give what is under way."""
        waiting = self.book.open()
        if self._current is None and waiting:
            if queued and waiting[0].state == missions.QUEUED:
                self.book.begin(waiting[0], now_ns)
            if waiting[0].state != missions.QUEUED:
                self._launch(waiting[0], missions.first_verb(waiting[0]), now_ns)
        return self._current

    def _launch(self, mission: Mission, verb: Verb, now_ns: int) -> None:
        self._current = mission
        self._teleop.operate(verb, now_ns)
        if isinstance(verb, Continue):
            mission.witness = mission.witness.after_restart()
            text = "teleop has restarted; the robot is asked to go on"
            self._note(mission, "restarted", text, now_ns)
        elif mission.state == missions.QUEUED:
            self._note(mission, "starting", "the robot is asked to start", now_ns)
        self._collect(now_ns)

    def _watch(self, mission: Mission, seen: Seen, now_ns: int) -> None:
        """Write down at once what the robot touches."""
        before = mission.witness
        mission.witness = before.see(seen)
        for event, text in mission.witness.news(before, self._teleop.elapsed(now_ns)):
            self._note(mission, event, text, now_ns)

    def _collect(self, now_ns: int) -> None:
        for output in self._teleop.take_outputs():
            if isinstance(output, Setpoint):
                self._setpoint, self._setpoint_ns = output, now_ns + SETPOINT_PERIOD_NS
            elif isinstance(output, MissionEvent):
                self._follow(output, now_ns)
            self._outputs.append(output)
        if trouble := self.book.news():
            self._outputs.append(Fault(now_ns, "journal", trouble))

    def _follow(self, event: MissionEvent, now_ns: int) -> None:
        mission, seen = self._current, self.sight.seen
        assert mission is not None, "events are of missions only"
        changed: dict[str, Any] = {"waypoint": event.waypoint} if event.waypoint >= 0 else {}
        if event.event == "started" and seen is not None:
            changed |= {"world": seen.world, "witness": asdict(Witness.begin(seen))}
        outcome = self._teleop.outcome
        if outcome is not None and event.event == outcome.code:
            elapsed = self._teleop.elapsed(now_ns)
            changed["verdict"] = mission.judged(outcome, self._contact_speed_max, elapsed)
        self._note(mission, event.event, event.text, now_ns, **changed)
        if mission.ended:
            self._current = None

    def _note(self, mission: Mission, event: str, text: str, now_ns: int, **changed: Any) -> None:
        if mission is self._current:
            changed["time_s"] = round(self._teleop.elapsed(now_ns), 3)
        self.book.note(mission, event, text, **changed)
