"""World's recording in a flight whose disk fails: whatever is left of it must be right."""

from __future__ import annotations

import tempfile
from itertools import pairwise
from pathlib import Path
from typing import ClassVar

from cloudrc.errors import CloudrcError
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import generator
from cloudrc.faults.scenarios.disk import LOSS_MAX, SYNC
from cloudrc.faults.schedule import Event, Schedule
from cloudrc.faults.scribe import ForgetfulWriter, FullDisk, Scribe, SlowWriter
from cloudrc.faults.toll import Generator
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.record.recover import recover
from cloudrc.records import GroundTruth, Record

ROOM = 1 << 30
"""Of a disk that is not full [bytes]."""
KILLED = ("recorder_killed", "power_cut")
"""Kinds that leave a file without its end."""


class Remains:
    """Records what happens in the while of each fault of the recording's disk, and reads it."""

    KINDS: ClassVar[tuple[str, ...]] = ("recorder_full", "recorder_slow", *KILLED)

    def __init__(self, flight: Flight, schedule: Schedule) -> None:
        """Listen to the flight if the schedule has such a fault."""
        self._flight = flight
        rng = generator(schedule.seed, 44)
        self._tapes: list[Tape | CutTape] = [
            CutTape(event, rng) if event.kind in KILLED else Tape(event)
            for event in schedule.of(*self.KINDS)
        ]
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
                return self._miscounted(0) if recorder.error else str(error)
        if recovery.bytes_lost:
            return f"{recovery.bytes_lost} torn bytes are left"
        if stamps != self._truths[: len(stamps)]:
            return "it does not hold what has happened"
        if not recorder.error and len(stamps) != len(self._truths):
            return f"{len(self._truths) - len(stamps)} samples lost without a word"
        return self._miscounted(recovery.kept["messages"])

    def _miscounted(self, kept: int) -> str:
        """Whether each record is in the file or counted, "" if so."""
        wrong = self._scribe.miscounted(kept)
        return f"the count of lost records is wrong by {wrong}" if wrong else ""

    def _open(self, path: Path) -> SlowWriter:
        self._writer = SlowWriter(self._disk, self._delay)
        return self._writer

    def _owed(self) -> float:
        return self._writer.pay() if self._writer is not None else 0.0


class CutTape:
    """One recording whose process is killed, or whose machine loses its power."""

    def __init__(self, event: Event, rng: Generator) -> None:
        self._from_ns, self._until_ns = round(event.at * 1e9), round(event.end * 1e9)
        self._power, self._rng = event.kind == "power_cut", rng
        self._folder = tempfile.TemporaryDirectory()
        self._path = Path(self._folder.name) / "world.mcap"
        self._writer: ForgetfulWriter | None = None
        self._recorder = Recorder(self._path, self._open)
        self._scribe = Scribe(self._recorder)
        self._truths: list[int] = []
        self._left: bytes | None = None

    def hear(self, records: list[Record], now_ns: int) -> None:
        """Record what happens in its while [ns], and come to an end in the middle of it."""
        if self._left is not None or now_ns < self._from_ns:
            return
        stamps = [r.stamp_ns for r in records if isinstance(r, GroundTruth)]
        self._truths += [stamp for stamp in stamps if stamp <= self._until_ns]
        if now_ns >= self._until_ns:
            self._left = self._cut()
            return
        if self._writer is not None:
            self._writer.now_ns = now_ns
        self._scribe.hear(records, now_ns)

    def wrong(self) -> str:
        """Recover what is left as a user would; say what is wrong, "" if nothing is."""
        left = self._left if self._left is not None else self._cut()
        self._recorder.close()
        torn, mended = self._path.with_name("torn.mcap"), self._path.with_name("mended.mcap")
        torn.write_bytes(left)
        try:
            recover(torn, mended)
            stamps = Recording.read(mended)["/ground_truth"]["stamp_ns"].tolist()
        except CloudrcError:
            stamps = []  # nothing has reached the disk yet: how much that was is asked below
        finally:
            self._folder.cleanup()
        if stamps != self._truths[: len(stamps)]:
            return "what was recovered has not happened so"
        # What was flown and is lost: while world is dead or frozen nothing is, and nobody records.
        period_ns = min((after - before for before, after in pairwise(self._truths)), default=0)
        lost = (len(self._truths) - len(stamps)) * period_ns * 1e-9
        return f"its last {lost:.2f} s are lost" if lost > LOSS_MAX else ""

    def _cut(self) -> bytes:
        if self._writer is None:
            return b""
        if self._power:
            return self._writer.after_power_cut(self._until_ns, self._rng)
        return self._path.read_bytes()

    def _open(self, path: Path) -> ForgetfulWriter:
        self._writer = ForgetfulWriter(path, SYNC)
        return self._writer
