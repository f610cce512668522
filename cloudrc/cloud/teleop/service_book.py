"""The book of missions: what happens is written down first, and only then counts.

Everything that is known of a mission follows from its entries, so that what is known after a
restart is what was known before. Entries go to `write`, which keeps them: the journal.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable
from itertools import islice, takewhile
from typing import Any

from cloudrc.cloud.teleop.journal_format import Entry
from cloudrc.cloud.teleop.service_backlog import Backlog
from cloudrc.cloud.teleop.service_mission import (
    CANCELLED,
    NEVER_BEGAN,
    QUEUED,
    Mission,
    Order,
    from_entry,
    never_began,
    number_of,
    order_entry,
)
from cloudrc.errors import CloudrcError

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


class MissionBook:
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
