"""World's recording in a flight whose disk fails: whatever is left of it must be right."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import ClassVar

from cloudrc.errors import CloudrcError
from cloudrc.faults.flight import Flight
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.faults.scribe import FullDisk, Scribe, SlowWriter
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.record.recover import recover
from cloudrc.records import GroundTruth, Record

ROOM = 1 << 30
"""Of a disk that is not full [bytes]."""


class Remains:
    """Records what happens in the while of each fault of the recording's disk, and reads it."""

    KINDS: ClassVar[tuple[str, ...]] = ("recorder_full", "recorder_slow")

    def __init__(self, flight: Flight, schedule: Schedule) -> None:
        """Listen to the flight if the schedule has such a fault."""
        self._flight = flight
        self._tapes = [Tape(event) for event in schedule.of(*self.KINDS)]
        flight.listeners += [tape.hear for tape in self._tapes]

    def judge(self) -> None:
        """Note what is wrong with what is left."""
        for tape in self._tapes:
            if wrong := tape.wrong():
                self._flight.watch.note(self._flight.run.now_ns, "recording", wrong)


class Tape:
    """One recording on one bad disk."""

    def __init__(self, event: Event) -> None:
        self._from_ns, self._until_ns = round(event.at * 1e9), round(event.end * 1e9)
        full = event.kind == "recorder_full"
        self._disk = FullDisk(int(event.value) if full else ROOM)
        self._writer: SlowWriter | None = None
        self._delay = 0.0 if full else event.value
        self._recorder = Recorder(Path("world.mcap"), self._open)
        self._scribe = Scribe(self._recorder, self._owed)
        self._truths: list[int] = []

    def hear(self, records: list[Record], now_ns: int) -> None:
        """Record what happens in its while [ns]."""
        if self._from_ns <= now_ns <= self._until_ns:
            self._truths += [r.stamp_ns for r in records if isinstance(r, GroundTruth)]
            self._scribe.hear(records, now_ns)

    def wrong(self) -> str:
        """Read it as a user would; say what is wrong, "" if nothing is."""
        recorder = self._recorder
        recorder.close()
        if recorder.dropped and not recorder.error:
            return f"{recorder.dropped} records dropped without a word"
        kept = self._disk.getvalue()
        with tempfile.TemporaryDirectory() as folder:
            path, mended = Path(folder) / "world.mcap", Path(folder) / "mended.mcap"
            path.write_bytes(kept)
            try:
                recovery = recover(path, mended)
                stamps = Recording.read(mended)["/ground_truth"]["stamp_ns"].tolist()
            except CloudrcError as error:
                # A disk with no room for a single chunk leaves nothing, and has said so.
                return "" if recorder.error else str(error)
        if recovery.bytes_lost:
            return f"{recovery.bytes_lost} torn bytes are left"
        if stamps != self._truths[: len(stamps)]:
            return "it does not hold what has happened"
        if not recorder.error and len(stamps) != len(self._truths):
            return f"{len(self._truths) - len(stamps)} samples lost without a word"
        return ""

    def _open(self, path: Path) -> SlowWriter:
        self._writer = SlowWriter(self._disk, self._delay)
        return self._writer

    def _owed(self) -> float:
        return self._writer.pay() if self._writer is not None else 0.0
