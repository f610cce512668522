"""Store missions and their progress in an SQLite file; read them after a restart.

A mission is one row: its order, written once, and its status, written with each event. A waypoint
cannot be stored twice as reached, because mission and index are the key of a row. A transaction is
on the disk when it returns (`synchronous=FULL`), so a process that is killed at any instant loses
at most the event that it is writing. The number of missions and the number of events per mission
are bounded.

If the disk is full or fails, the store refuses new missions, but flights continue. Their events
stay in memory. Once the disk works again, the store writes these events before anything else.

An old and a new teleop can overlap when a pod is replaced. The file is locked for one of them.
"""

from __future__ import annotations

import hashlib
import json
import os
import sqlite3
from collections import Counter, deque
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.messages import Start
from cloudrc.metrics.verdict import Failure, Observations, Verdict
from cloudrc.teleop.wire import Continue, Leg, Plan

Event: TypeAlias = dict[str, Any]
"""An event of a mission, as the API shows it."""

QUEUED, STARTING, FLYING, HELD = "queued", "starting", "flying", "held"
DONE, FAILED, CANCELLED = "done", "failed", "cancelled"
ENDED = (DONE, FAILED, CANCELLED)
SHOWN = 100
"""Limit of the events that are kept per mission; the newest are kept. A mission has about ten
events, but a held mission gets one more each time it is sent to another place."""
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
"""State of a mission after an event; other events do not change the state."""


@dataclass(frozen=True, slots=True)
class Order:
    """Order of a mission.

    Attributes:
        plan: Checked plan.
        name: Name for people.
        key: Key of the request; a second order with the same key makes no second mission. "" if
            the order has no key.
        contact: Whether the arm has to touch the board.
        queue: Whether the order may wait for the mission under way. Otherwise it is refused.
    """

    plan: Plan
    name: str = ""
    key: str = ""
    contact: bool = False
    queue: bool = False


@dataclass(slots=True)
class Mission:
    """A mission and its progress.

    Attributes:
        id: Identifier, such as "m1".
        order: The order.
        number: Number of the mission on board; below 2^63.
        state: One of the values of `STATES`.
        world: World in which the mission was started; "" before the start.
        elapsed: Duration of the mission at its last event [s].
        reached: Index and time [s] of each reached waypoint.
        events: The newest events, as the API shows them.
        happened: Count of each kind of event, including events that are no longer kept.
        witness: What the robot has touched.
        verdict: The verdict, as the API shows it; None until the mission has ended.
    """

    id: str
    order: Order
    number: int = 0
    state: str = QUEUED
    world: str = ""
    elapsed: float = 0.0
    reached: list[dict[str, Any]] = field(default_factory=list)
    events: deque[Event] = field(default_factory=lambda: deque(maxlen=SHOWN))
    happened: Counter[str] = field(default_factory=Counter)
    witness: Observations = field(default_factory=Observations)
    verdict: dict[str, Any] | None = None

    @property
    def ended(self) -> bool:
        """Whether the mission is over."""
        return self.state in ENDED

    @property
    def waypoint(self) -> int:
        """Index of the current waypoint; at the end, index of the last waypoint."""
        return min(len(self.reached), len(self.order.plan.legs) - 1)

    def apply(
        self, number: int, event: str, text: str, *, waypoint: int | None = None, **changed: Any
    ) -> None:
        """Update the mission with an event.

        Args:
            number: Number of the event.
            event: Kind of the event, one word.
            text: Description of the event.
            waypoint: Index of the event's waypoint; None for the current waypoint.
            changed: New values of attributes: elapsed, world, witness, verdict.
        """
        waypoint = self.waypoint if waypoint is None else waypoint
        for name, value in changed.items():
            setattr(self, name, value)
        shown = {"id": number, "mission": self.id, "event": event, "waypoint": waypoint}
        self.events.append({**shown, "text": text, "time_s": self.elapsed})
        self.happened[event] += 1
        self.state = STATES.get(event, self.state)
        if event == "reached" and waypoint == len(self.reached):
            self.reached.append({"waypoint": waypoint, "time_s": self.elapsed})

    def before(self) -> Continue | None:
        """Return the state from which a new teleop continues; None if the mission did not start."""
        if not self.world:
            return None
        held, plan = self.state == HELD, self.order.plan
        return Continue(plan, self.waypoint, self.elapsed, self.world, held, self.number)

    def copy(self) -> Mission:
        """Copy the mission; an event of the copy does not change the original."""
        reached, events, happened = [*self.reached], self.events.copy(), self.happened.copy()
        return replace(self, reached=reached, events=events, happened=happened)

    def summary(self) -> dict[str, Any]:
        """Return the fields that a list of missions shows."""
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
        """Return all fields that the API shows."""
        left_out = self.happened.total() - len(self.events)
        return {**self.summary(), "events": list(self.events), "events_left_out": left_out}


def number_of(mission_id: str, salt: bytes) -> int:
    """Compute the number of a mission on board, from 1 to 2^63 - 1.

    Args:
        mission_id: Identifier of the mission; identifiers begin again with a new file.
        salt: Random bytes that no other process has.
    """
    digest = hashlib.sha256(salt + mission_id.encode()).digest()
    return int.from_bytes(digest[:8], "little") >> 1 or 1


class UnknownMissionError(CloudrcError):
    """Report that no mission has this id."""


class UnavailableError(CloudrcError):
    """Report that the service is not available at present.

    Causes: the journal cannot be written, another teleop has locked it, or this teleop is ending.
    """


class StoreLockedError(CloudrcError):
    """Report that another process has locked the file."""


class ConflictError(CloudrcError):
    """Report that the present state does not allow a request.

    `mission` is the id of the mission that is in conflict, "" if none.
    """

    exit_code = 5

    def __init__(self, text: str, mission: str = "") -> None:
        super().__init__(text)
        self.mission = mission


def busy(mission: Mission, advice: str) -> ConflictError:
    """Make the error for a mission that is in conflict."""
    return ConflictError(f"mission {mission.id} is {mission.state}; {advice}", mission.id)


APPLICATION, VERSION = 0x43524A32, 1
"""Numbers in the head of the file: the identifier of cloudrc's files, and the version of the
tables."""
SCHEMA = f"""
CREATE TABLE mission (n INTEGER PRIMARY KEY, plan TEXT NOT NULL, status TEXT NOT NULL);
CREATE TABLE reached (mission INTEGER REFERENCES mission ON DELETE CASCADE, waypoint INTEGER,
    time_s REAL NOT NULL, PRIMARY KEY (mission, waypoint)) WITHOUT ROWID;
CREATE TABLE event (id INTEGER PRIMARY KEY, body TEXT NOT NULL,
    mission INTEGER NOT NULL REFERENCES mission ON DELETE CASCADE);
CREATE INDEX event_of ON event (mission);
PRAGMA application_id = {APPLICATION};
PRAGMA user_version = {VERSION};
"""
SQLITE, OLD_JOURNAL = b"SQLite format 3\0", b"\x93CRJ"
"""First bytes of an SQLite file, and first bytes of a journal of cloudrc up to version 0.1."""
NUMBERS = ("application_id", "user_version")
SIDE_FILES = ("", "-wal", "-shm", "-journal")
"""Suffixes of the files that belong to one SQLite database."""


def open_store(path: Path, salt: bytes, factory: Any = sqlite3.Connection) -> MissionStore:
    """Open the file of missions and lock it; make a new file if there is none.

    A damaged file or a journal of an earlier version is renamed, and `MissionStore.notice` says so.

    Args:
        path: Path of the file.
        salt: Random bytes for the numbers of missions.
        factory: Class of the connection.

    Raises:
        StoreLockedError: If another process has locked the file.
        BadInputError: If the file is not a file of missions, has another version, or cannot be
            made.
    """
    head = _head(path)
    if head.startswith(OLD_JOURNAL):
        aside = _set_aside(path, "old")
        text = f"{path}: a journal of an earlier version, which is not read; it is kept as {aside}"
        return MissionStore(connect(path, factory), salt, notice=text)
    if head and head != SQLITE:
        raise BadInputError(f"--journal {path}: is no journal; move it away, or name another file")
    try:
        return MissionStore(connect(path, factory), salt)
    except sqlite3.OperationalError as error:
        raise _not_opened(path, error) from None
    except sqlite3.DatabaseError as error:
        aside = _set_aside(path, "damaged")
        reason = " ".join(str(error).split())
        text = f"journal repaired: {path}: {reason}; its missions are lost, it is kept as {aside}"
    return MissionStore(connect(path, factory), salt, notice=text, damaged=True)


def _head(path: Path) -> bytes:
    """Read the first bytes of the file; if there is none, make one that only the owner can use."""
    if path.exists() and not path.is_file():
        raise BadInputError(f"--journal {path}: is not a file; name another one")
    path.parent.mkdir(parents=True, exist_ok=True)
    with os.fdopen(os.open(path, os.O_RDWR | os.O_CREAT, 0o600), "rb") as file:
        return file.read(len(SQLITE))


def _set_aside(path: Path, why: str) -> Path:
    """Rename a file and the files of `SIDE_FILES`; return the new path of the file."""
    aside = path.with_name(f"{path.name}.{why}")
    for ending in SIDE_FILES:
        with suppress(FileNotFoundError):
            Path(f"{path}{ending}").replace(f"{aside}{ending}")
    return aside


def connect(path: Path | None = None, factory: Any = sqlite3.Connection) -> sqlite3.Connection:
    """Connect to a file of missions, lock it, and check it.

    Args:
        path: Path of the file; None for memory.
        factory: Class of the connection.

    Raises:
        StoreLockedError: If another process has locked the file.
        BadInputError: If the file has another version, or cannot be made.
        sqlite3.DatabaseError: If the file is damaged.
    """
    # The thread that serves missions may be another one than that which opens the file.
    db: sqlite3.Connection = sqlite3.connect(
        path or ":memory:", timeout=0, isolation_level=None, check_same_thread=False,
        factory=factory,
    )  # fmt: skip
    try:
        db.executescript(
            "PRAGMA locking_mode = EXCLUSIVE; PRAGMA journal_mode = WAL; "
            "PRAGMA synchronous = FULL; PRAGMA foreign_keys = ON; BEGIN EXCLUSIVE; COMMIT;"
        )
        if not db.execute("PRAGMA schema_version").fetchone()[0]:
            db.executescript(f"BEGIN;{SCHEMA}COMMIT;")
        known = [db.execute(f"PRAGMA {name}").fetchone()[0] for name in NUMBERS]
        if known != [APPLICATION, VERSION]:
            text = "this version cannot read it; move it away, or name another file"
            raise BadInputError(f"--journal {path}: {text}")
        if (found := db.execute("PRAGMA quick_check").fetchone()[0]) != "ok":
            raise sqlite3.DatabaseError(found)
    except BaseException as error:
        db.close()
        if isinstance(error, sqlite3.OperationalError):
            raise _not_opened(path, error) from None
        raise
    return db


def _not_opened(path: Path | None, error: sqlite3.OperationalError) -> CloudrcError:
    if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:  # without its extension
        return StoreLockedError(
            f"{path}: another teleop has this journal open; waiting until it ends"
        )
    return BadInputError(f"--journal {path}: {error}; free or repair its volume, or name another")


QUEUE_MAX = 16
"""Limit of the missions that wait for the one under way."""
KEPT = 100
"""Limit of the ended missions that the store keeps."""
KEEP_PERIOD_NS = 1_000_000_000
"""Time between two attempts to write events that the disk has refused [ns]."""
LOGGED = 5_000
"""Limit of the events of all missions together that a reader can request."""


class MissionStore:
    """All missions, oldest first.

    Attributes:
        missions: Missions by id.
        trouble: Why the disk has refused the last event; "" if the disk has accepted it.
        dropped: Number of events that a reader has requested too late, after their removal.
        notice: What was wrong with an earlier file and where it is now; "" if nothing was wrong.
        damaged: Whether a damaged file was renamed.
    """

    def __init__(
        self,
        connection: sqlite3.Connection,
        salt: bytes,
        *,
        notice: str = "",
        damaged: bool = False,
    ) -> None:
        """Read the missions of a file.

        Args:
            connection: Connection from `connect`; an error closes the connection.
            salt: Random bytes for the numbers of missions.
            notice: See the attribute.
            damaged: See the attribute.

        Raises:
            sqlite3.DatabaseError: If a row cannot be read.
        """
        self._db, self._salt, self.notice, self.damaged = connection, salt, notice, damaged
        self._events = 0
        self._unsaved: dict[str, int] = {}  # mission -> its first event that is not on the disk
        self.missions: dict[str, Mission] = {}
        self.trouble, self._told, self._keep_ns = "", "", 0
        self.dropped, self._missed = 0, 0
        self._log: deque[Event] = deque(maxlen=LOGGED)
        try:
            self._read()
        except sqlite3.OperationalError:  # the disk fails, which is no damage of the content
            connection.close()
            raise
        except (sqlite3.DatabaseError, BadInputError, LookupError, TypeError, ValueError) as error:
            connection.close()
            raise sqlite3.DatabaseError(f"a row cannot be read: {error!r}") from error

    @property
    def kept(self) -> bool:
        """Whether all events are on the disk."""
        return not self._unsaved

    def open(self) -> list[Mission]:
        """Return the missions that have not ended; the first is the one to fly."""
        return [mission for mission in self.missions.values() if not mission.ended]

    def stopped(self) -> Mission | None:
        """Return the mission whose emergency stop the operator has not acknowledged yet, if any."""
        for mission in reversed(self.missions.values()):
            events = mission.happened
            if "started" in events or "emergency_stopped" in events:
                waits = "emergency_stopped" in events and "acknowledged" not in events
                return mission if waits else None
        return None

    def waits_for(self, order: Order) -> list[Mission]:
        """Return the missions for which a new mission has to wait.

        Raises:
            ConflictError: If a mission is under way and the order may not wait, or if too many
                missions wait.
        """
        before = self.open()
        if before and not order.queue:
            raise busy(before[0], "cancel it first, or queue the new one")
        if len(before) > QUEUE_MAX:
            raise ConflictError(f"{QUEUE_MAX} missions wait already; cancel one", before[0].id)
        return before

    def find(self, mission_id: str) -> Mission:
        """Return a mission.

        Raises:
            UnknownMissionError: If no mission has this id.
        """
        mission = self.missions.get(mission_id)
        if mission is None:
            raise UnknownMissionError(f"no mission '{mission_id}'; 'cloudrc mission list' has all")
        return mission

    def has_ended(self, number: int) -> bool:
        """Return whether the mission with this number on board is over."""
        return any(mission.number == number and mission.ended for mission in self.missions.values())

    def with_key(self, key: str) -> Mission | None:
        """Return the mission whose order has this key, if any."""
        return next((m for m in self.missions.values() if key and m.order.key == key), None)

    def add(self, order: Order) -> Mission:
        """Store a new mission; delete the oldest ended missions if there are more than `KEPT`.

        Raises:
            UnavailableError: If the mission cannot be stored; then it does not exist.
        """
        mission_id = f"m{int(next(reversed(self.missions), 'm0')[1:]) + 1}"
        number = number_of(mission_id, self._salt)
        mission = Mission(mission_id, replace(order, queue=False), number)
        ended = [each.id for each in self.missions.values() if each.ended]
        old = ended[: max(0, len(ended) - KEPT)]
        self._commit("no mission can start", mission, old)
        self.missions[mission_id] = mission
        for each in old:
            del self.missions[each]
        return mission

    def begin(self, mission: Mission, now_ns: int) -> None:
        """Store at `now_ns` [ns] that a waiting mission starts; if that fails, it keeps waiting."""
        if now_ns < self._keep_ns:
            return
        try:
            self._save(f"{mission.id} waits", mission, "starting", "the robot is asked to start")
        except UnavailableError as error:
            self.trouble, self._keep_ns = str(error), now_ns + KEEP_PERIOD_NS

    def cancel(self, mission: Mission) -> None:
        """Store that a waiting mission will not begin.

        Raises:
            UnavailableError: If this cannot be stored, because the next teleop would fly the
                mission.
        """
        verdict = Verdict("interrupted", (Failure("cancelled", NEVER_BEGAN),)).as_json()
        waits = f"{mission.id} waits on"
        self._save(waits, mission, "cancelled", NEVER_BEGAN, verdict=verdict)

    def note(self, mission: Mission, event: str, text: str, **changed: Any) -> None:
        """Store an event of a mission, at once or as soon as the disk works again.

        Args:
            mission: The mission.
            event: Kind of the event, one word.
            text: Description of the event.
            changed: See `Mission.apply`.
        """
        if event == "reached" and changed["waypoint"] < len(mission.reached):
            return  # an earlier teleop has stored it
        self._unsaved.setdefault(mission.id, self._events + 1)
        self._apply(mission, event, text, **changed)
        self._try_to_save()

    def catch_up(self, now_ns: int) -> None:
        """Try again to write events that the disk has refused, if due at `now_ns` [ns]."""
        if self._unsaved and now_ns >= self._keep_ns:
            self._try_to_save()
            self._keep_ns = now_ns + (KEEP_PERIOD_NS if self.trouble else 0)

    def news(self) -> str:
        """Return `trouble` once; "" if there is none, or if an earlier call has returned it."""
        told, self._told = self._told, self.trouble
        return "" if told == self.trouble else self.trouble

    def events_after(self, number: int) -> list[Event]:
        """Return the events of all missions after the event with this number."""
        if number > self._events:  # of a file that is gone
            number = 0
        if number and self._log:  # without a number nobody has missed anything
            last = self._log[0]["id"] - 1
            if (missed := last - max(number, self._missed)) > 0:
                self.dropped += missed
                self._missed = last
        return list(takewhile(lambda event: event["id"] > number, reversed(self._log)))[::-1]

    def close(self) -> None:
        """Close the file, so that the next teleop can open it."""
        self._db.close()

    def _apply(self, mission: Mission, event: str, text: str, **changed: Any) -> None:
        self._events += 1
        mission.apply(self._events, event, text, **changed)
        self._log.append(mission.events[-1])

    def _save(self, refused: str, mission: Mission, event: str, text: str, **changed: Any) -> None:
        """Store an event of a mission; if that fails, leave the mission unchanged."""
        after = mission.copy()
        after.apply(self._events + 1, event, text, **changed)
        self._commit(refused, after)
        self._apply(mission, event, text, **changed)

    def _try_to_save(self) -> None:
        with suppress(UnavailableError):
            self._commit("")

    def _commit(
        self, refused: str, changed: Mission | None = None, old: Iterable[str] | None = None
    ) -> None:
        """Write the events that are not on the disk yet, and then a mission, in one transaction.

        Args:
            refused: Consequence of a failure, in words, for the error.
            changed: A mission with one new event, or a new mission; None for neither.
            old: Missions to delete; None unless `changed` is a new mission.

        Raises:
            UnavailableError: If the disk refuses.
        """
        db = self._db
        try:
            db.execute("BEGIN")
            for mission_id, first in self._unsaved.items():
                self._write(self.missions[mission_id], first)
            if changed is not None and old is not None:
                row = _row(changed), to_json(changed.order, changed.number), _status(changed)
                db.execute("INSERT INTO mission VALUES (?, ?, ?)", row)
                db.executemany("DELETE FROM mission WHERE n = ?", [(int(e[1:]),) for e in old])
            elif changed is not None:
                self._write(changed, changed.events[-1]["id"])
            db.commit()
        except sqlite3.DatabaseError as error:
            with suppress(sqlite3.DatabaseError):
                db.rollback()
            self.trouble = f"the journal cannot be written: {error}; free or repair its volume"
            raise UnavailableError(f"{refused}: {self.trouble}") from error
        self._unsaved.clear()
        self.trouble = self._told = ""

    def _write(self, mission: Mission, first: int) -> None:
        """Write the status of a mission, its events from `first`, and its waypoints."""
        db, row, events = self._db, _row(mission), mission.events
        db.execute("UPDATE mission SET status = ? WHERE n = ?", (_status(mission), row))
        new = [(each["id"], json.dumps(each), row) for each in events if each["id"] >= first]
        db.executemany("INSERT INTO event VALUES (?, ?, ?)", new)
        db.execute("DELETE FROM event WHERE mission = ? AND id < ?", (row, events[0]["id"]))
        (there,) = db.execute("SELECT count(*) FROM reached WHERE mission = ?", (row,)).fetchone()
        reached = [(row, each["waypoint"], each["time_s"]) for each in mission.reached[there:]]
        db.executemany("INSERT INTO reached VALUES (?, ?, ?)", reached)

    def _read(self) -> None:
        for row, order, status in self._db.execute("SELECT * FROM mission ORDER BY n"):
            mission = from_json(f"m{row}", order, **json.loads(status))
            self.missions[mission.id] = mission
        for row, *reached in self._db.execute("SELECT * FROM reached ORDER BY mission, waypoint"):
            each = dict(zip(("waypoint", "time_s"), reached, strict=True))
            self.missions[f"m{row}"].reached.append(each)
        for number, body, row in self._db.execute("SELECT * FROM event ORDER BY id"):
            self.missions[f"m{row}"].events.append(event := json.loads(body))
            self._log.append(event)
            self._events = number


def _row(mission: Mission) -> int:
    return int(mission.id[1:])


def _status(mission: Mission) -> str:
    status = {name: getattr(mission, name) for name in ("state", "world", "elapsed", "verdict")}
    return json.dumps(
        {**status, "happened": mission.happened, "witness": mission.witness.as_json()}
    )


def to_json(order: Order, number: int) -> str:
    """Write an order and the number of its mission as JSON."""
    plan = order.plan
    legs = [[leg.position, leg.yaw, leg.tolerance, leg.dwell, leg.time_limit] for leg in plan.legs]
    fields = {"name": order.name, "key": order.key, "contact": order.contact}
    start = {"start": plan.start.name, "time_limit": plan.time_limit, "legs": legs}
    return json.dumps({"number": number, **fields, **start})


def from_json(
    mission_id: str, order: str, happened: dict[str, int], witness: dict[str, Any], **status: Any
) -> Mission:
    """Read a mission without its events and waypoints.

    Args:
        mission_id: Identifier of the mission.
        order: Text from `to_json`.
        happened: Count of each kind of event.
        witness: Attributes of the mission's observations.
        status: Other attributes of the mission.
    """
    read = json.loads(order)
    legs = tuple(Leg(tuple(position), *rest) for position, *rest in read["legs"])
    plan = Plan(legs, Start[read["start"]], read["time_limit"])
    mission = Mission(
        mission_id,
        Order(plan, read["name"], read["key"], read["contact"]),
        read["number"],
        **status,
    )
    mission.happened, mission.witness = Counter(happened), Observations(**witness)
    return mission
