"""Faults of disks: full, read-only and slow ones, a killed recorder, a torn journal."""

from __future__ import annotations

import errno
import io
import tempfile
from collections.abc import Callable
from math import nan
from pathlib import Path
from typing import Any

from cloudrc.faults import asks
from cloudrc.faults.family_intruder import Generator, generator
from cloudrc.faults.family_link import instant
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, Scenario
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.record.recover import recover
from cloudrc.record.writer import McapWriter
from cloudrc.records import Record

FLUSH_NS = 250_000_000
"""As `cloudrc.drivers.recording` does [ns]."""
LOSS_MAX = 0.5
"""Of a recording, when its process is killed [s]."""


class FullDisk(io.BytesIO):
    """A file on a disk that has room for so many bytes."""

    def __init__(self, room: int) -> None:
        super().__init__()
        self.room = room

    def write(self, data: Any) -> int:
        """Take the bytes, or refuse."""
        if self.tell() + len(data) > self.room:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(data)


class SlowWriter(McapWriter):
    """Each `sync` takes its time [s]."""

    def __init__(self, path: Path, delay: float) -> None:
        super().__init__(path, clock="world")
        self.delay, self.owed = delay, 0.0

    def sync(self) -> None:
        """Owe the time that it takes."""
        super().sync()
        self.owed += self.delay


class Scribe:
    """The recording thread in virtual time: it drains, flushes, and waits for its disk."""

    def __init__(self, recorder: Recorder, owed: Callable[[], float] = lambda: 0.0) -> None:
        self._recorder, self._owed = recorder, owed
        self._busy_until_ns = self._flushed_ns = 0
        self.longest_queue = 0

    def hear(self, records: list[Record], now_ns: int) -> None:
        """Take new records over at an instant [ns]."""
        self._recorder.put(records)
        self.longest_queue = max(self.longest_queue, len(self._recorder._queue))
        if now_ns < self._busy_until_ns:
            return
        while self._recorder.drain():
            pass
        if now_ns - self._flushed_ns >= FLUSH_NS:
            self._flushed_ns = now_ns
            self._recorder.flush()
            self._busy_until_ns = now_ns + round(self._owed() * 1e9)


def _bad_disks(seed: int) -> Outcome:
    outcome = Outcome()
    clean = Flight(seed=seed).fly_mission()
    with tempfile.TemporaryDirectory() as folder:
        for name, check in (("full", _full), ("read-only", _read_only), ("slow", _slow)):
            flight = Flight(seed=seed)
            check(outcome, flight, Path(folder))
            asks.safe(outcome, flight)
            text = f"{name} disk: the same records, bit by bit"
            outcome.true(text, flight.sha256() == clean.sha256())
    return outcome


def _full(outcome: Outcome, flight: Flight, folder: Path) -> None:
    disk = FullDisk(500_000)
    recorder = Recorder(folder / "w.mcap", lambda path: McapWriter(disk, clock="world"))
    flight.listeners.append(Scribe(recorder).hear)
    flight.fly_mission()
    recorder.close()
    kept = folder / "full.mcap"
    kept.write_bytes(disk.getvalue())
    told = recorder.error
    outcome.true("full disk: recording stopped: disk full", "recording stopped: disk full" in told)
    outcome.least("full disk: records counted as dropped", recorder.dropped, 1000)
    recovery = recover(kept, folder / "full.recovered.mcap")
    outcome.same("full disk: torn chunks left", recovery.bytes_lost, 0)
    outcome.least("full disk: messages kept", recovery.kept["messages"], 1000)
    note = Recording.read(kept).note
    outcome.true("full disk: a reader is told", "disk full" in note)


def _read_only(outcome: Outcome, flight: Flight, folder: Path) -> None:
    def refuse(path: Path) -> McapWriter:
        raise OSError(errno.EROFS, "Read-only file system")

    recorder = Recorder(folder / "ro.mcap", refuse)
    flight.listeners.append(Scribe(recorder).hear)
    flight.fly_mission()
    recorder.close()
    outcome.true("read-only disk: it is told", "disk is read-only" in recorder.error)
    outcome.least("read-only disk: records counted as dropped", recorder.dropped, 1000)


def _slow(outcome: Outcome, flight: Flight, folder: Path) -> None:
    writers: list[SlowWriter] = []

    def open_slow(path: Path) -> SlowWriter:
        writers.append(SlowWriter(path, 5.0))
        return writers[0]

    def owed() -> float:
        owed, writers[0].owed = writers[0].owed, 0.0
        return owed

    path = folder / "slow.mcap"
    recorder = Recorder(path, open_slow)
    flight.listeners.append(Scribe(recorder, owed).hear)
    flight.fly_mission()
    recorder.close()
    outcome.same("slow disk: records dropped", recorder.dropped, 0)
    outcome.true("slow disk: the file is whole", Recording.read(path).complete)


def _recorder_killed(seed: int) -> Outcome:
    """Kill the recorder at 20 instants of one flight, by SIGKILL and by a power cut."""
    outcome, rng = Outcome(), generator(seed, 30)
    instants = sorted(rng.uniform(1.0, 30.0, 20).tolist())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path, copies = folder / "world.mcap", dict[float, bytes]()
        recorder = Recorder(path, lambda file: McapWriter(file, clock="world"))
        flight, scribe = Flight(seed=seed), Scribe(recorder)

        def hear(records: list[Record], now_ns: int) -> None:
            while instants and instants[0] * 1e9 <= now_ns:
                copies[instants.pop(0)] = path.read_bytes()
            scribe.hear(records, now_ns)

        flight.listeners.append(hear)
        flight.fly_mission()
        recorder.close()
        losses, shares, wrong = [], [], 0
        whole = Recording.read(path)["/ground_truth"]["stamp_ns"].tolist()
        for at, data in copies.items():
            torn, mended = folder / "torn.mcap", folder / "mended.mcap"
            torn.write_bytes(data)
            recovery = recover(torn, mended)
            shares.append(recovery.share)
            stamps = Recording.read(mended)["/ground_truth"]["stamp_ns"].tolist()
            wrong += stamps != whole[: len(stamps)]
            losses.append(at - stamps[-1] * 1e-9)
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    outcome.most("longest stretch lost", max(losses, default=nan), LOSS_MAX, "s")
    outcome.same("recoveries that differ from what was recorded", wrong, 0)
    outcome.least("kept, share of the bytes", min(shares, default=nan), 0.9)
    return outcome


def _torn_journal(seed: int) -> Outcome:
    """The pod dies in the middle of a transition; then a bit of its journal is wrong."""
    outcome = Outcome()
    for damage in (_tear, _rot):
        with tempfile.TemporaryDirectory() as folder:
            _damage_journal(outcome, seed, Path(folder) / "missions.journal", damage)
    return outcome


Damage = Callable[[bytearray, Generator], None]


def _tear(data: bytearray, rng: Generator) -> None:
    del data[-int(rng.integers(1, 40)) :]


def _rot(data: bytearray, rng: Generator) -> None:
    data[-int(rng.integers(10, 60))] ^= 4


def _damage_journal(outcome: Outcome, seed: int, path: Path, damage: Damage) -> None:
    at, rng = instant(seed, 8.0, 22.0), generator(seed, 36)
    flight = Flight(seed=seed, journal=path)

    def die(now_ns: int) -> None:
        flight.kill_cloud_pod(now_ns, 1.0)
        data = bytearray(path.read_bytes())
        damage(data, rng)
        path.write_bytes(data)

    flight.cloud.at(at, die)
    flight.fly_mission()
    asks.safe(outcome, flight)
    outcome.true("mission done", flight.mission.state == "done")
    outcome.true("journal repaired, it says", "repaired" in " ".join(flight.desk.repairs))
    reached = [each["waypoint"] for each in flight.mission.reached]
    every = list(range(len(flight.mission.order.plan.legs)))
    outcome.true("in the journal, too, each waypoint was reached once", reached == every)
    flight.desk.kill()


SCENARIOS = (
    Scenario(
        29,
        "bad-disk",
        "the recording's disk is full, read-only, or takes 5 s for every fsync",
        "the flight is the same, bit by bit; the chunk is closed cleanly",
        "samples, which are counted",
        "recording stopped: disk full; cloudrc_recorder_dropped_records_total",
        _bad_disks,
    ),
    Scenario(
        30,
        "recorder-killed",
        "SIGKILL and power cut at 20 instants of a flight",
        "the flight is unaffected; the rest recovers with right checksums",
        "at most 0.5 s of the recording",
        "cloudrc recover: kept 99 %",
        _recorder_killed,
    ),
    Scenario(
        36,
        "torn-journal",
        "the journal's end is torn off, or has a wrong bit",
        "the last whole entry counts, the robot is the second witness",
        "at most one transition, which is found again",
        "journal repaired",
        _torn_journal,
    ),
)
