"""The book of missions: what happens is written down first, and only then counts.

Everything that is known of a mission follows from its entries, so that what is known after a
restart is what was known before. Entries go to `write`, which keeps them: the journal.

One mission as teleop remembers it: journal entries come in; what the API shows goes out.

What the journal has not taken yet: entries come in; all reach it, in order, once it can write.

A full disk does not stop a flight: what happens meanwhile waits here, and goes before whatever is
written next. How many can wait is bounded: what tells of a mission's end or of a waypoint reached
stays, and there are no more of them than missions and waypoints; of all else the newest stay.
"""

from __future__ import annotations

import hashlib
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from itertools import islice, takewhile
from typing import Any

from cloudrc.errors import CloudrcError
from cloudrc.messages import Start
from cloudrc.teleop.journal import Entry
from cloudrc.teleop.verdict import Criteria, Failure, MissionObservations, Verdict, judge
from cloudrc.teleop.wire import Continue, Leg, Outcome, Plan, StartMission

QUEUED, STARTING, FLYING, HELD = "queued", "starting", "flying", "held"
DONE, FAILED, CANCELLED = "done", "failed", "cancelled"
ENDED = (DONE, FAILED, CANCELLED)
SHOWN = 100
"""Events of a mission that are shown, the newest: a mission has some ten, but one that is held can
be sent elsewhere without end, and every answer has them. The journal keeps the others, too."""
NEVER_BEGAN = "mission cancelled before it began"

STATES = {
    "queued": QUEUED,
    "starting": STARTING,
    "started": FLYING,
    "resumed": FLYING,
    "held": HELD,
    "done": DONE,
    "cancelled": CANCELLED,
    "timed_out": FAILED,
    "leg_timed_out": FAILED,
    "world_restarted": FAILED,
    "guard_stopped": FAILED,
    "emergency_stopped": FAILED,
    "taken_over": FAILED,
    "end_lost": FAILED,
}
"""State of a mission after an event; one that is not named here changes nothing."""


@dataclass(frozen=True, slots=True)
class Order:
    """What somebody asks to be flown.

    Attributes:
        plan: Checked.
        name: For people.
        key: The same key never makes a second mission; "" for none.
        contact: Whether the arm has to touch the board.
        queue: Whether to wait for the mission that is under way, in place of being refused.
    """

    plan: Plan
    name: str = ""
    key: str = ""
    contact: bool = False
    queue: bool = False


@dataclass(slots=True)
class Mission:
    """Everything that is known of a mission; it follows from its journal entries alone.

    Attributes:
        id: Given by teleop.
        order: What was asked for.
        number: Names it on board, where its progress is kept, too; below 2^63, 0 if it is not.
        state: One of `STATES`.
        world: Names the world in which it was started; "" before that.
        elapsed: How long it had lasted at its last event [s].
        reached: Index of each waypoint reached and when [s].
        events: The newest of what has happened, as the API shows it.
        happened: How often each event has, the older ones counted.
        witness: What the robot has touched.
        verdict: As the API shows it; None until it has ended.
    """

    id: str
    order: Order
    number: int = 0
    state: str = QUEUED
    world: str = ""
    elapsed: float = 0.0
    reached: list[dict[str, Any]] = field(default_factory=list)
    events: deque[dict[str, Any]] = field(default_factory=lambda: deque(maxlen=SHOWN))
    happened: Counter[str] = field(default_factory=Counter)
    witness: MissionObservations = field(default_factory=MissionObservations)
    verdict: dict[str, Any] | None = None

    @property
    def ended(self) -> bool:
        """Whether it is over."""
        return self.state in ENDED

    @property
    def waypoint(self) -> int:
        """Index of the waypoint that is flown to, or was at the end."""
        return min(len(self.reached), len(self.order.plan.legs) - 1)

    def apply(self, entry: Entry) -> None:
        """Take in an entry of kind "event"."""
        event = {k: entry[k] for k in ("id", "mission", "event", "waypoint", "text", "time_s")}
        self.events.append(event)
        self.happened[entry["event"]] += 1
        self.state = STATES.get(entry["event"], self.state)
        self.elapsed, self.world = entry["time_s"], entry["world"]
        if self.world and self.state in (QUEUED, STARTING):
            self.state = FLYING  # it was started, though a damaged journal has lost what said so
        self.witness = MissionObservations(**entry["witness"])
        self.verdict = entry.get("verdict", self.verdict)
        # A waypoint is reached once, whatever is told how often.
        if entry["event"] == "reached" and entry["waypoint"] == len(self.reached):
            self.reached.append({"waypoint": entry["waypoint"], "time_s": entry["time_s"]})

    def in_new_session(self) -> str:
        """What to say when the controller has another session with the same robot."""
        where = f"waypoint {self.waypoint + 1} of {len(self.order.plan.legs)}"
        goes_on = f"is held on the way to {where}" if self.state == HELD else f"goes on to {where}"
        return f"the controller has a new session, as after a restart; the mission {goes_on}"

    def judged(self, outcome: Outcome, contact_speed_max: float, elapsed: float) -> dict[str, Any]:
        """The verdict on how it ended, as the API shows it.

        Args:
            outcome: How that was.
            contact_speed_max: Below which the arm's tip may meet the board [m/s].
            elapsed: How long it has lasted [s].
        """
        criteria = Criteria(self.order.contact, contact_speed_max)
        count = len(self.order.plan.legs)
        return judge(outcome, self.witness, criteria, waypoints=count, elapsed=elapsed).as_json()

    def forsake(self) -> None:
        """A later mission has begun: this one is over, although nothing kept says how it ended."""
        text = "how it ended was not kept: the journal was damaged or could not be written"
        self.state = FAILED
        self.verdict = Verdict("failure", (Failure("end_lost", text),)).as_json()

    def entry(self, number: int, event: str, text: str, **changed: Any) -> Entry:
        """Make the entry of something that happens to the mission now."""
        return {
            "kind": "event",
            "id": number,
            "mission": self.id,
            "event": event,
            "text": text,
            "waypoint": self.waypoint,
            "time_s": round(self.elapsed, 3),
            "world": self.world,
            "witness": asdict(self.witness),
            **changed,
        }

    def summary(self) -> dict[str, Any]:
        """What a list of missions shows."""
        return {
            "id": self.id,
            "name": self.order.name,
            "key": self.order.key,
            "state": self.state,
            "waypoint": self.waypoint,
            "waypoints": len(self.order.plan.legs),
            "reached": list(self.reached),
            "verdict": self.verdict,
        }

    def as_json(self) -> dict[str, Any]:
        """Everything, but no more than `SHOWN` events, as the API shows it."""
        left_out = self.happened.total() - len(self.events)
        return {**self.summary(), "events": list(self.events), "events_left_out": left_out}


def order_entry(mission: Mission) -> Entry:
    """Make the entry that a mission begins with."""
    order, plan = mission.order, mission.order.plan
    return {
        "kind": "mission",
        "mission": mission.id,
        "number": mission.number,
        "name": order.name,
        "key": order.key,
        "contact": order.contact,
        "start": plan.start.name,
        "time_limit": plan.time_limit,
        "legs": [
            [list(leg.position), leg.yaw, leg.tolerance, leg.dwell, leg.time_limit]
            for leg in plan.legs
        ],
    }


def from_entry(entry: Entry) -> Mission:
    """Make the mission that an entry of kind "mission" began."""
    legs = tuple(Leg(tuple(position), *rest) for position, *rest in entry["legs"])
    plan = Plan(legs, Start[entry["start"]], entry["time_limit"])
    order = Order(plan, entry["name"], entry["key"], entry["contact"])
    return Mission(entry["mission"], order, entry["number"])


def number_of(mission_id: str, salt: bytes) -> int:
    """Name a mission in 63 bits; ids begin again with a new journal, the salt does not.

    Args:
        mission_id: Ours, such as "m1".
        salt: Bytes that no other journal had.
    """
    digest = hashlib.sha256(salt + mission_id.encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1 or 1


def never_began() -> dict[str, Any]:
    """The verdict on a mission that was cancelled before it began, as the API shows it."""
    return Verdict("interrupted", (Failure("cancelled", NEVER_BEGAN),)).as_json()


def first_verb(mission: Mission) -> StartMission | Continue:
    """How to begin: anew, or where a teleop before this one left off."""
    plan, number = mission.order.plan, mission.number
    if not mission.world:
        return StartMission(plan, number, again=True)
    held = mission.state == HELD
    return Continue(plan, mission.waypoint, mission.elapsed, mission.world, held, number)


PASSING_MAX = 1_000
"""Entries that wait at most, those that stay in any case not counted."""
AT_ONCE = 20
"""Entries written at once: each takes the disk its time, and the flight goes on."""


class Backlog:
    """Stands before a journal and forgets nothing that matters."""

    def __init__(self, write: Callable[[Entry], None]) -> None:
        """Begin with nothing.

        Args:
            write: Keeps an entry; raises OSError if it cannot.
        """
        self._write = write
        self._waiting: list[Entry] = []

    def __len__(self) -> int:
        return len(self._waiting)

    def append(self, entry: Entry) -> None:
        """Keep an entry, after all that wait, or not at all.

        Raises:
            OSError: If it is not kept.
        """
        while self._waiting:
            self.flush()
        self._write(entry)

    def note(self, entry: Entry) -> None:
        """Keep an entry, after all that wait, now or later.

        Raises:
            OSError: If the disk refuses; the entry waits then, too.
        """
        self._waiting.append(entry)
        try:
            self.flush()
        finally:
            self._shorten()

    def flush(self) -> None:
        """Write some of what waits, oldest first.

        Raises:
            OSError: If the disk refuses; what is left waits on.
        """
        for _ in range(min(AT_ONCE, len(self._waiting))):
            self._write(self._waiting[0])
            del self._waiting[0]

    def _shorten(self) -> None:
        """Drop the oldest entry that nothing depends on, if there are too many."""
        if len(self._waiting) <= PASSING_MAX:
            return
        passing = [n for n, entry in enumerate(self._waiting) if _passes(entry)]
        if len(passing) > PASSING_MAX:
            newest = {self._waiting[n]["mission"]: n for n in passing if _leads(self._waiting[n])}
            del self._waiting[next(n for n in passing if n not in newest.values())]


def _passes(entry: Entry) -> bool:
    """Whether newer entries of the mission say all that follows from it, but for its state."""
    return entry["event"] != "reached" and "verdict" not in entry


def _leads(entry: Entry) -> bool:
    """Whether it tells the mission's state."""
    return entry["event"] in STATES


QUEUE_MAX = 16
"""Missions that may wait for the one under way."""
KEPT = 100
"""Missions that have ended and are still known."""
KEEP_PERIOD_NS = 1_000_000_000
"""Between two tries to write what the disk has refused [ns]."""
LOGGED = 5_000
"""Events, of all missions together, that can still be asked for: a number and not a time, since a
mission has some ten, and a reader who was away for a minute is to miss none."""


class UnknownMissionError(CloudrcError):
    """There is no mission of this id."""


class UnavailableError(CloudrcError):
    """Not now: the journal cannot be written, another teleop holds it, or this one ends."""


class ConflictError(CloudrcError):
    """The state does not allow it; `mission` is the id of the mission in the way, "" if none."""

    exit_code = 5

    def __init__(self, text: str, mission: str = "") -> None:
        super().__init__(text)
        self.mission = mission


def busy(mission: Mission, advice: str) -> ConflictError:
    """What to raise where a mission is in the way."""
    return ConflictError(f"mission {mission.id} is {mission.state}; {advice}", mission.id)


class MissionStore:
    """All missions, oldest first.

    Attributes:
        missions: By id.
        trouble: Why the disk has refused the last entry; "" if it has not.
        dropped: Events that were asked for by somebody who had some, and are forgotten; each counts
            once, however often it is asked for.
    """

    def __init__(
        self, write: Callable[[Entry], None], entries: Iterable[Entry], salt: bytes
    ) -> None:
        """Read what was written before.

        Args:
            write: Keeps an entry; raises OSError if it cannot.
            entries: What was kept, oldest first.
            salt: Makes numbers of missions that no other book has.
        """
        self._backlog, self._salt = Backlog(write), salt
        self._numbered = self._events = 0
        self.missions: dict[str, Mission] = {}
        self.trouble, self._told, self._keep_ns = "", "", 0
        self.dropped, self._missed = 0, 0
        self._log: deque[dict[str, Any]] = deque(maxlen=LOGGED)
        for entry in entries:
            self._apply(entry)

    @property
    def kept(self) -> bool:
        """Whether the disk has taken everything."""
        return not self._backlog

    def knows(self, entry: Entry) -> bool:
        """Whether an entry is of a mission that is still known."""
        return entry["mission"] in self.missions

    def open(self) -> list[Mission]:
        """Missions that have not ended; the first is the one to fly."""
        return [mission for mission in self.missions.values() if not mission.ended]

    def stopped(self) -> Mission | None:
        """Give the mission that the operator has stopped, and not acknowledged since, if any."""
        for mission in reversed(self.missions.values()):
            events = mission.happened
            if "started" in events or "emergency_stopped" in events:
                waits = "emergency_stopped" in events and "acknowledged" not in events
                return mission if waits else None
        return None

    def waits_for(self, order: Order) -> list[Mission]:
        """Give the missions that a new one has to wait for.

        Raises:
            ConflictError: If there are any and the order does not want to wait, or too many do.
        """
        before = self.open()
        if before and not order.queue:
            raise busy(before[0], "cancel it first, or queue the new one")
        if len(before) > QUEUE_MAX:
            raise ConflictError(f"{QUEUE_MAX} missions wait already; cancel one", before[0].id)
        return before

    def find(self, mission_id: str) -> Mission:
        """Give a mission.

        Raises:
            UnknownMissionError: If there is none of this id.
        """
        mission = self.missions.get(mission_id)
        if mission is None:
            raise UnknownMissionError(f"no mission '{mission_id}'; 'cloudrc mission list' has all")
        return mission

    def has_ended(self, number: int) -> bool:
        """Whether a mission, by the number under which the robot knows it, is over."""
        return any(mission.number == number and mission.ended for mission in self.missions.values())

    def with_key(self, key: str) -> Mission | None:
        """Give the mission that was ordered under a key, if any."""
        found = (m for m in self.missions.values() if key and m.order.key == key)
        return next(found, None)

    def add(self, order: Order) -> Mission:
        """Write a new mission down.

        Raises:
            UnavailableError: If it cannot be kept; it then does not exist.
        """
        mission_id = f"m{self._numbered + 1}"
        entry = order_entry(Mission(mission_id, order, number_of(mission_id, self._salt)))
        self._append(entry, "no mission can start")
        return self.missions[entry["mission"]]

    def begin(self, mission: Mission, now_ns: int) -> None:
        """Write down that a mission that waits is asked to start [ns]; else it waits on."""
        if now_ns < self._keep_ns:
            return
        try:
            text = "the robot is asked to start"
            self._append(mission.entry(self._events + 1, "starting", text), f"{mission.id} waits")
            self.trouble = self._told = ""
        except UnavailableError as error:
            self.trouble, self._keep_ns = str(error), now_ns + KEEP_PERIOD_NS

    def cancel(self, mission: Mission) -> None:
        """Write down that a mission that waits will not begin.

        Raises:
            UnavailableError: If it cannot be kept: a teleop after this one would fly it.
        """
        entry = mission.entry(self._events + 1, "cancelled", NEVER_BEGAN, verdict=never_began())
        self._append(entry, f"{mission.id} waits on")

    def note(self, mission: Mission, event: str, text: str, **changed: Any) -> None:
        """Write down what happens to a mission, or as soon as the disk can be written again.

        Args:
            mission: Which.
            event: One word.
            text: The same in words.
            changed: Values of the entry that are not as they were: waypoint, time_s, world,
                witness, verdict.
        """
        entry = mission.entry(self._events + 1, event, text, **changed)
        if event == "reached" and entry["waypoint"] < len(mission.reached):
            return  # the last one, which a teleop before has written down
        self._try(lambda: self._backlog.note(entry))
        self._apply(entry)

    def catch_up(self, now_ns: int) -> None:
        """Write down what waits for the disk, if it is time [ns] for that."""
        if self._backlog and now_ns >= self._keep_ns:
            self._try(self._backlog.flush)
            self._keep_ns = now_ns + (KEEP_PERIOD_NS if self.trouble else 0)

    def news(self) -> str:
        """Say once what is the trouble; "" if there is none, or it has been told."""
        told, self._told = self._told, self.trouble
        return "" if told == self.trouble else self.trouble

    def events_after(self, number: int) -> list[dict[str, Any]]:
        """Give the events of all missions that came after the one of this number."""
        if number > self._events:  # of a journal that is gone
            number = 0
        if number and self._log:  # without a number nobody has missed anything
            last = self._log[0]["id"] - 1
            if (missed := last - max(number, self._missed)) > 0:
                self.dropped += missed
                self._missed = last
        return list(takewhile(lambda event: event["id"] > number, reversed(self._log)))[::-1]

    def _append(self, entry: Entry, refused: str) -> None:
        try:
            self._backlog.append(entry)
        except OSError as error:
            raise UnavailableError(
                f"{refused}: the journal cannot be written: {error.strerror}; "
                "free or mend its volume"
            ) from error
        self._apply(entry)

    def _try(self, write: Callable[[], None]) -> None:
        try:
            write()
            self.trouble = self._told = ""
        except OSError as error:
            self.trouble = f"the journal cannot be written: {error.strerror}; free its volume"

    def _apply(self, entry: Entry) -> None:
        if entry["kind"] == "mission":
            mission = from_entry(entry)
            self.missions[mission.id] = mission
            self._numbered = int(mission.id.removeprefix("m"))
            self._forget_old()
        elif (known := self.missions.get(entry["mission"])) is not None:
            waited = known.state == QUEUED
            known.apply(entry)
            if waited and known.state not in (QUEUED, CANCELLED):
                self._forsake_before(known)
            self._log.append(known.events[-1])
            self._events = entry["id"]

    def _forsake_before(self, begun: Mission) -> None:
        """Missions are flown one after the other: those before one that has begun are over."""
        for mission in takewhile(lambda mission: mission is not begun, self.missions.values()):
            if not mission.ended:
                mission.forsake()

    def _forget_old(self) -> None:
        ended = [mission.id for mission in self.missions.values() if mission.ended]
        for mission_id in islice(ended, max(0, len(ended) - KEPT)):
            del self.missions[mission_id]
