"""Faults of disks: full, read-only and slow ones, a killed recorder."""

from __future__ import annotations

import errno
import tempfile
from math import nan
from pathlib import Path

from cloudrc.faults import asks
from cloudrc.faults import asks as meters
from cloudrc.faults.flight import Flight
from cloudrc.faults.scenario import Outcome, Scenario, generator
from cloudrc.faults.scribe import ForgetfulWriter, FullDisk, Scribe, SlowWriter
from cloudrc.record.columns import Recording
from cloudrc.record.recorder import Recorder
from cloudrc.record.recover import recover
from cloudrc.record.writer import McapWriter
from cloudrc.records import Record

SYNC = 0.1
"""That the disk takes for it [s]."""
LOSS_MAX = 0.5
"""Of a recording, when its process is killed [s]."""
UNTOLD_MAX = 0.05
"""Of what a power cut takes: what the metric does not tell before [s]."""


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
    dropped, scribe = Dropped(recorder), Scribe(recorder)
    flight.listeners += [scribe.hear, dropped.look]
    flight.fly_mission()
    recorder.close()
    kept = folder / "full.mcap"
    kept.write_bytes(disk.getvalue())
    told = recorder.error
    outcome.true("full disk: recording stopped: disk full", "recording stopped: disk full" in told)
    outcome.least("full disk: records counted as dropped", recorder.dropped, 1000)
    dropped.judge(outcome)
    recovery = recover(kept, folder / "full.recovered.mcap")
    outcome.same("full disk: torn chunks left", recovery.bytes_lost, 0)
    messages = recovery.kept["messages"]
    outcome.least("full disk: messages kept", messages, 1000)
    text = "full disk: records counted too many or too few"
    outcome.same(text, scribe.miscounted(messages), 0)
    note = Recording.read(kept).note
    outcome.true("full disk: a reader is told", "disk full" in note)


def _read_only(outcome: Outcome, flight: Flight, folder: Path) -> None:
    def refuse(path: Path) -> McapWriter:
        raise OSError(errno.EROFS, "Read-only file system")

    recorder = Recorder(folder / "ro.mcap", refuse)
    scribe = Scribe(recorder)
    flight.listeners.append(scribe.hear)
    flight.fly_mission()
    recorder.close()
    outcome.true("read-only disk: it is told", "disk is read-only" in recorder.error)
    outcome.least("read-only disk: records counted as dropped", recorder.dropped, 1000)
    text = "read-only disk: records counted too many or too few"
    outcome.same(text, scribe.miscounted(0), 0)


def _slow(outcome: Outcome, flight: Flight, folder: Path) -> None:
    writers: list[SlowWriter] = []

    def open_slow(path: Path) -> SlowWriter:
        writers.append(SlowWriter(path, 5.0))
        return writers[0]

    path = folder / "slow.mcap"
    recorder = Recorder(path, open_slow)
    flight.listeners.append(Scribe(recorder, lambda: writers[0].pay()).hear)
    flight.fly_mission()
    recorder.close()
    outcome.same("slow disk: records dropped", recorder.dropped, 0)
    outcome.true("slow disk: the file is whole", Recording.read(path).complete)


class Dropped:
    """Looks when a recorder begins to count what it drops."""

    def __init__(self, recorder: Recorder) -> None:
        self._recorder = recorder
        self._failed_ns = self._counted_ns = -1

    def look(self, records: list[Record], now_ns: int) -> None:
        """Note when it says that something is wrong, and when it has counted something [ns]."""
        if self._recorder.error and self._failed_ns < 0:
            self._failed_ns = now_ns
        if self._recorder.dropped and self._counted_ns < 0:
            self._counted_ns = now_ns

    def judge(self, outcome: Outcome) -> None:
        """Check that the metric, which shows the count at once, moves in time."""
        delay = (self._counted_ns - self._failed_ns) * 1e-9 if self._counted_ns >= 0 else nan
        name = "recorder_dropped_records_total"
        outcome.most(f"metric {name} moves after", delay, meters.SOON, "s")
        meters.counts(outcome, "world", "recorder_dropped", self._recorder.dropped, name)


def _recorder_killed(seed: int) -> Outcome:
    """Kill the recorder at 20 instants of one flight, by SIGKILL and by cuts of the power."""
    outcome, rng = Outcome(), generator(seed, 30)
    instants = sorted(rng.uniform(1.0, 30.0, 20).tolist())
    copies, ages = list[tuple[str, float, bytes]](), dict[float, float]()
    with tempfile.TemporaryDirectory() as name:
        path, writers = Path(name) / "world.mcap", list[ForgetfulWriter]()

        def open_forgetful(path: Path) -> ForgetfulWriter:
            writers.append(ForgetfulWriter(path, SYNC))
            return writers[0]

        recorder = Recorder(path, open_forgetful)
        flight, scribe = Flight(seed=seed), Scribe(recorder)

        def hear(records: list[Record], now_ns: int) -> None:
            while instants and instants[0] * 1e9 <= now_ns:
                at, there = instants.pop(0), path.read_bytes()
                copies.append(("SIGKILL", at, there))
                ages[at] = writers[0].sync_age(round(at * 1e9)) or nan
                for how, chance in (("power cut", None), ("power cut, torn pages", rng)):
                    left = writers[0].after_power_cut(round(at * 1e9), chance)
                    if left != there:
                        copies.append((how, at, left))
            if writers:
                writers[0].now_ns = now_ns
            scribe.hear(records, now_ns)

        flight.listeners.append(hear)
        flight.fly_mission()
        recorder.close()
        _judge_remains(outcome, path, copies, ages)
    asks.safe(outcome, flight)
    asks.done(outcome, flight)
    return outcome


def _judge_remains(
    outcome: Outcome, path: Path, copies: list[tuple[str, float, bytes]], ages: dict[float, float]
) -> None:
    """What is left of a recording holds nothing wrong, and all but its last half second."""
    whole = Recording.read(path)["/ground_truth"]["stamp_ns"].tolist()
    torn, mended = path.with_name("torn.mcap"), path.with_name("mended.mcap")
    losses, wrong, untold, shares = dict[str, float](), 0, list[float](), list[float]()
    for how, at, data in copies:
        torn.write_bytes(data)
        recovery = recover(torn, mended)
        stamps = Recording.read(mended)["/ground_truth"]["stamp_ns"].tolist()
        wrong += stamps != whole[: len(stamps)]
        lost = at - stamps[-1] * 1e-9
        losses[how] = max(losses.get(how, 0.0), lost)
        if how == "SIGKILL":
            shares.append(recovery.share)
        if how == "power cut":
            untold.append(abs(lost - ages[at]))
    for how, lost in losses.items():
        outcome.most(f"{how}: longest stretch lost", lost, LOSS_MAX, "s")
    outcome.least("SIGKILL: kept, the share that is told", min(shares, default=nan), 0.99)
    text = "metric recorder_sync_age_seconds differs from what a power cut took by"
    outcome.most(text, max(untold, default=nan), UNTOLD_MAX, "s")
    outcome.same("recoveries that differ from what was recorded", wrong, 0)
    outcome.least("of them after a power cut that has forgotten something", len(copies) - 20, 4)


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
        "SIGKILL, and a power cut that forgets what was not synced, at 20 instants of a flight",
        "the flight is unaffected; the rest recovers with right checksums",
        "at most 0.5 s of the recording",
        "cloudrc recover: kept 99 % after SIGKILL; before, what a power cut would take: "
        "cloudrc_recorder_sync_age_seconds",
        _recorder_killed,
    ),
)
