"""What may happen once only, and in its order: a command is flown, a waypoint is reached."""

from __future__ import annotations

from cloudrc.faults.flight import Flight
from cloudrc.records import CommandApplied, Record, SessionOpened


class Once:
    """Listens to a flight through every life of its ends, and reads its journal."""

    def __init__(self, flight: Flight) -> None:
        """Listen from now on."""
        self._flight = flight
        self._newest = (0, -1)  # epoch and counter
        flight.listeners.append(self.hear)

    def hear(self, records: list[Record], now_ns: int) -> None:
        """Note a command [ns] that is older than one flown before, or of an epoch that is over."""
        for record in records:
            kind = type(record)
            if kind is CommandApplied:
                self._take(record.epoch, record.counter, record.stamp_ns)  # type: ignore[union-attr]
            elif kind is SessionOpened:
                self._take(record.epoch, -1, record.stamp_ns)  # type: ignore[union-attr]

    def judge(self) -> None:
        """Note a mission whose waypoints the journal has as reached twice, or out of order."""
        reached: dict[str, list[int]] = {}
        for entry in self._flight.desk.entries:
            if entry.get("event") == "reached":
                reached.setdefault(entry["mission"], []).append(entry["waypoint"])
        for mission, waypoints in reached.items():
            if waypoints != list(range(len(waypoints))):
                text = f"{mission} reached its waypoints as {waypoints}"
                self._flight.watch.note(self._flight.run.now_ns, "waypoint", text)

    def _take(self, epoch: int, counter: int, stamp_ns: int) -> None:
        if (epoch, counter) <= self._newest:
            text = f"command {counter} of epoch {epoch} after {self._newest}"
            self._flight.watch.note(stamp_ns, "order", text)
        self._newest = max(self._newest, (epoch, counter))
