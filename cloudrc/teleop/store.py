# SPDX-License-Identifier: Apache-2.0

"""Store missions and their progress in an SQLite file; read them after a restart of teleop.

One row holds a mission's order and status; each event changes the status. A transaction returns
after its data is on the disk, so a killed process loses at most the newest event. While the disk
refuses to write, flights continue, events stay in memory, and no new mission starts.
"""

from __future__ import annotations

import hashlib
import json
import sqlite3
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeAlias

from pydantic import TypeAdapter

from cloudrc.base.errors import CloudrcError, StateError
from cloudrc.config.schema import Touch
from cloudrc.results.metrics.verdict import Observations
from cloudrc.teleop.refusals import UnavailableError, UnknownMissionError
from cloudrc.teleop.wire import ENDED, QUEUED, STATES, EventName, Plan
from cloudrc.wire.records import MissionState

Event: TypeAlias = dict[str, Any]
"""An event of a mission, in the form of the API's model `Event`."""
SHOWN = 100
"""Largest number of events that the store keeps for each mission: the newest events."""


@dataclass(frozen=True, slots=True)
class Order:
    """Order to fly a mission, with a plan that has been checked."""

    plan: Plan
    name: str = ""  # shown to people
    key: str = ""  # orders with the same key make one mission; "": no key
    touch: Touch | None = None  # what the robot has to touch; None: nothing
    queue: bool = False  # whether the order waits for the mission under way; else it is refused
    lease: float = 0.0  # longest time without word from the mission's watcher [s]; 0: no watcher

    @property
    def touched(self) -> str | None:
        """Name of the body that the robot has to touch; None without one."""
        return self.touch.body if self.touch else None


@dataclass(slots=True)
class MissionRecord:
    """A mission and its progress."""

    id: str  # such as "m1"
    order: Order
    number: int  # identifies the mission on board; below 2^63
    state: MissionState = QUEUED
    world: str = ""  # world's process in which the mission started; "" before
    elapsed: float = 0.0  # duration of the mission at its last event [s]
    reached: list[dict[str, Any]] = field(default_factory=list)  # waypoints with their times [s]
    events: deque[Event] = field(default_factory=lambda: deque(maxlen=SHOWN))  # the newest
    happened: Counter[str] = field(default_factory=Counter)  # number of events, by kind
    witness: Observations = field(default_factory=Observations)  # contacts in telemetry, and slip
    verdict: dict[str, Any] | None = None  # as the API shows it; None until the mission has ended

    @property
    def ended(self) -> bool:
        """Whether the mission is over."""
        return self.state in ENDED

    @property
    def waypoint(self) -> int:
        """Index of the current waypoint; at the mission's end, index of the last waypoint."""
        return min(len(self.reached), len(self.order.plan.legs) - 1)

    def apply(
        self,
        number: int,
        event: EventName,
        text: str,
        *,
        waypoint: int | None = None,
        **changed: Any,
    ) -> None:
        """Add an event to the mission, and set the mission's attributes that `changed` names.

        `number` is the id of the event, `waypoint` its waypoint, by default the current waypoint.
        """
        waypoint = self.waypoint if waypoint is None else waypoint
        for name, value in changed.items():
            setattr(self, name, value)
        shown = {"id": number, "mission": self.id, "event": event, "waypoint": waypoint}
        self.events.append({**shown, "text": text, "time_s": self.elapsed})
        self.happened[event] += 1
        self.state = STATES.get(event, self.state)
        if event == "reached":
            self.reached.append({"waypoint": waypoint, "time_s": self.elapsed})

    def summary(self) -> dict[str, Any]:
        """Return the fields of the API's model `MissionSummary`."""
        return {
            "id": self.id,
            "name": self.order.name,
            "key": self.order.key,
            "state": self.state,
            "waypoint": self.waypoint,
            "by_hand": self.order.plan.by_hand,
            "waypoints": len(self.order.plan.waypoints),
            "reached": list(self.reached),
            "verdict": self.verdict,
        }

    def as_json(self) -> dict[str, Any]:
        """Return the fields of the API's model `MissionView`."""
        return {
            **self.summary(),
            "route_m": [leg.position for leg in self.order.plan.waypoints],
            "events": list(self.events),
            "events_left_out": self.happened.total() - len(self.events),
        }


class StoreLockedError(CloudrcError):
    """Report that another process has locked the file of missions."""


SCHEMA = "CREATE TABLE missions (n INTEGER PRIMARY KEY, plan TEXT NOT NULL, status TEXT NOT NULL)"


def open_store(path: Path, salt: bytes) -> MissionStore:
    """Open and lock the file of missions; make a new file if there is none.

    A damaged file is renamed and replaced by a new file; then `MissionStore.notice` tells the user.

    Raises:
        StoreLockedError: If another process has locked the file.
        StateError: If the file does not contain missions, or cannot be read or made.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    path.touch(0o600)
    try:
        return MissionStore(connect(path), salt)
    except sqlite3.DatabaseError as error:
        reason = str(error)
        code = getattr(error, "sqlite_errorcode", 0) & 0xFF  # without the extended code
    if code == sqlite3.SQLITE_BUSY:
        raise StoreLockedError(f"{path}: another teleop has this journal open; waiting for its end")
    if code not in (0, sqlite3.SQLITE_CORRUPT):  # no database, or a disk that fails
        raise StateError(f"journal {path}: {reason}; repair or move it, or name another file")
    aside = path.with_name(f"{path.name}.damaged")
    for ending in ("", "-wal"):  # the files of one database
        if (part := Path(f"{path}{ending}")).exists():
            part.replace(f"{aside}{ending}")
    text = f"journal repaired: {path}: {reason}; its missions are lost, it is kept as {aside}"
    return MissionStore(connect(path), salt, text)


def connect(path: Path | None = None, factory: Any = sqlite3.Connection) -> sqlite3.Connection:
    """Open and lock a database of missions, in a file or, without a path, in memory.

    Raise a `sqlite3.DatabaseError` if the file is locked or damaged, or if its volume fails.
    """
    # One thread opens the file; another thread may serve the missions.
    how: dict[str, Any] = {"timeout": 0, "isolation_level": None, "check_same_thread": False}
    db: sqlite3.Connection = sqlite3.connect(path or ":memory:", factory=factory, **how)
    try:
        db.executescript(
            "PRAGMA locking_mode = EXCLUSIVE; PRAGMA journal_mode = WAL; "
            "PRAGMA synchronous = FULL; BEGIN EXCLUSIVE; COMMIT;"
        )
        if db.execute("PRAGMA schema_version").fetchone() == (0,):  # a new file
            db.executescript(SCHEMA)
    except sqlite3.DatabaseError:
        db.close()
        raise
    return db


KEPT = 100
"""Largest number of ended missions that the store keeps."""
KEEP_PERIOD_NS = 1_000_000_000
"""Time between two attempts to write events that the disk has refused [ns]."""
_ORDER, _MISSION = TypeAdapter(Order), TypeAdapter(MissionRecord)
_FIXED = {"id", "number", "order"}
"""Attributes of a mission that its events do not change."""


class MissionStore:
    """Missions in memory and on the disk."""

    def __init__(self, db: sqlite3.Connection, salt: bytes, notice: str = "") -> None:
        """Read all missions of `db`; if that fails, close `db` and raise DatabaseError.

        The first mission in a new file has the id "m1". The robot stores progress by mission
        number; the random bytes `salt` make these numbers differ from those of an earlier file.
        `notice` tells what happened to a damaged earlier file; "" means that there is none.
        """
        self._db, self._salt = db, salt
        self.notice = notice  # what happened to a damaged earlier file; "" without such a file
        self.missions: dict[str, MissionRecord] = {}  # by id, oldest first
        self.trouble = ""  # why the disk refuses to write; "" if everything is on the disk
        self.dropped = 0  # number of events that readers missed, because they asked too late
        self._unsaved: set[str] = set()  # missions with events that are not on the disk
        self._events = self._keep_ns = 0  # number of the last event; time of the next attempt [ns]
        try:
            self._read()
        except (sqlite3.DatabaseError, LookupError, TypeError, ValueError) as error:
            db.close()
            if isinstance(error, sqlite3.DatabaseError):
                raise
            text = " ".join(repr(error).split())
            raise sqlite3.DatabaseError(f"a row cannot be read: {text}") from error

    def open(self) -> list[MissionRecord]:
        """Return the missions that have not ended, in the order in which they fly."""
        return [mission for mission in self.missions.values() if not mission.ended]

    def stopped(self) -> MissionRecord | None:
        """Return the mission that was flown last if an emergency stop ended it, else None."""
        events: set[EventName] = {"started", "emergency_stopped"}
        flown = [each for each in self.missions.values() if each.happened.keys() & events]
        return flown[-1] if flown and "emergency_stopped" in flown[-1].happened else None

    def find(self, mission_id: str) -> MissionRecord:
        """Return a mission; raise UnknownMissionError if none has this id."""
        if mission_id not in self.missions:
            raise UnknownMissionError(f"no mission '{mission_id}'; 'cloudrc mission list' has all")
        return self.missions[mission_id]

    def has_ended(self, number: int) -> bool:
        """Return whether a mission has ended; `number` is the mission's number in telemetry."""
        return any(mission.number == number and mission.ended for mission in self.missions.values())

    def with_key(self, key: str) -> MissionRecord | None:
        """Return the mission whose order has this key; None if there is none, or for the key ""."""
        return next((m for m in self.missions.values() if key and m.order.key == key), None)

    def add(self, order: Order) -> MissionRecord:
        """Store a new mission; delete the oldest ended missions if there are more than `KEPT`.

        Raises:
            UnavailableError: If the disk refuses to write; then there is no new mission.
        """
        mission_id = f"m{_row(next(reversed(self.missions), 'm0')) + 1}"
        digest = hashlib.sha256(self._salt + mission_id.encode()).digest()
        number = int.from_bytes(digest[:8], "little") >> 1 or 1
        mission = MissionRecord(mission_id, replace(order, queue=False), number)
        ended = [each.id for each in self.missions.values() if each.ended]
        old = ended[:-KEPT]
        if not self._commit(mission, old):
            raise UnavailableError(f"no mission can start: {self.trouble}")
        self.missions[mission_id] = mission
        for each in old:
            del self.missions[each]
        return mission

    def note(self, mission: MissionRecord, event: EventName, text: str, **changed: Any) -> None:
        """Store an event and `changed` fields of a mission; `catch_up` repeats a failed write."""
        if event == "reached" and changed["waypoint"] < len(mission.reached):
            return  # an earlier teleop has stored it
        self._events += 1
        self._unsaved.add(mission.id)
        mission.apply(self._events, event, text, **changed)
        self._commit()

    def catch_up(self, now_ns: int) -> None:
        """Write again the events that the disk has refused, if a retry is due at `now_ns` [ns]."""
        if self.trouble and now_ns >= self._keep_ns:
            self._keep_ns = now_ns + KEEP_PERIOD_NS
            self._commit()

    def events_after(self, number: int) -> list[Event]:
        """Return the events of all missions after the event `number`, oldest first."""
        if number > self._events:  # the reader has a number of an earlier file
            number = 0
        if number == self._events:  # each event stream asks ten times a second
            return []
        kept = (event for mission in self.missions.values() for event in mission.events)
        found = sorted((e for e in kept if e["id"] > number), key=lambda event: event["id"])
        if number:  # 0 is a new reader, who has missed nothing
            self.dropped += self._events - number - len(found)
        return found

    def close(self) -> None:
        """Close the file, so that the next teleop can open it."""
        self._db.close()

    def _commit(self, new: MissionRecord | None = None, old: Sequence[str] = ()) -> bool:
        """Write unsaved events and the mission `new` to the disk; delete missions `old` there.

        Return whether the disk has them; if not, `trouble` says why.
        """
        db = self._db
        try:
            db.execute("BEGIN")
            changed = [(_status(self.missions[each]), _row(each)) for each in self._unsaved]
            db.executemany("UPDATE missions SET status = ? WHERE n = ?", changed)
            if new is not None:
                order = json.dumps([new.number, _ORDER.dump_python(new.order, mode="json")])
                db.execute(
                    "INSERT INTO missions VALUES (?, ?, ?)", (_row(new.id), order, _status(new))
                )
            db.executemany("DELETE FROM missions WHERE n = ?", [(_row(each),) for each in old])
            db.commit()
        except sqlite3.DatabaseError as error:
            db.rollback()
            self.trouble = f"the journal cannot be written: {error}; free or repair its volume"
            return False
        self._unsaved.clear()
        self.trouble = ""
        return True

    def _read(self) -> None:
        for row, ordered, status in self._db.execute("SELECT * FROM missions ORDER BY n"):
            number, order = json.loads(ordered)
            known = {"id": f"m{row}", "number": number, "order": order, **json.loads(status)}
            mission = _MISSION.validate_python(known)
            mission.events = deque(mission.events, SHOWN)
            self._events = max(self._events, *(event["id"] for event in mission.events), 0)
            self.missions[mission.id] = mission


def _row(mission_id: str) -> int:
    return int(mission_id.removeprefix("m"))


def _status(mission: MissionRecord) -> str:
    return json.dumps(_MISSION.dump_python(mission, mode="json", exclude=_FIXED))
