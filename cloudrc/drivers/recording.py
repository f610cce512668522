"""The recording of a process in real time: a thread that empties the recorder into its file.

It takes a few records at a time and rests in between, so that the loop, which shares the
interpreter with it, is never kept waiting for longer than a fraction of a millisecond. With each
flush it looks whether the wall clock was set, at which the loop may not look. A second thread waits
for the disk: one that takes seconds keeps nothing from the operating system, which keeps what it
has when the process is killed.

Steps of the machine's wall clock, for people: nothing that flies may look at it.

It is seen against the clock that counts since boot, which nobody sets and which, unlike the
monotonic one, goes on while the machine sleeps. The thread of the recording looks; what an end
records of it is a fault with the size of the step.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Protocol

from cloudrc.exposition.ends import CLOCK_SET
from cloudrc.records import (
    Arrival,
    CommandApplied,
    Control,
    Fault,
    GroundTruth,
    Lateness,
    Record,
    TelemetrySent,
)

STEP = 0.1
"""A smaller difference between two looks is no step [s]."""
DRIFT_MAX = 1e-3
"""By which the two clocks may differ in speed: kernels slew by half of it at most."""
_SINCE_BOOT = getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC)  # the former: Linux


class WallClock:
    """Finds out that the wall clock was set."""

    def __init__(self) -> None:
        """Take it as it is now."""
        self._wall, self._boot = _now()

    def step(self) -> float:
        """Look again; say by how much it was set since the look before [s], 0 if it was not."""
        wall, boot = _now()
        passed, seemed = boot - self._boot, wall - self._wall
        self._wall, self._boot = wall, boot
        return seemed - passed if abs(seemed - passed) > STEP + DRIFT_MAX * passed else 0.0


def told(step: float, stamp_ns: int) -> Fault:
    """Make what is recorded of a step.

    Args:
        step: By how much it was set [s].
        stamp_ns: When that was noticed [ns], own clock of the end.
    """
    text = (
        f"wall clock stepped by {step:+.1f} s: the flight does not notice;"
        " times of day before and after it do not compare"
    )
    return Fault(stamp_ns, CLOCK_SET, text)


def _now() -> tuple[float, float]:
    """The wall clock, and the one that counts since boot [s], with no stall in between."""
    while True:
        before, wall = time.clock_gettime(_SINCE_BOOT), time.time()
        boot = time.clock_gettime(_SINCE_BOOT)
        if boot - before < STEP / 2.0:
            return wall, boot


AFTERWARDS_NS = 90_000_000_000
"""For so long after the robot has last followed the cloud, all is recorded still [ns]: until it has
landed after a loss of the link."""
PERIODIC = (Arrival, CommandApplied, Control, GroundTruth, Lateness, TelemetrySent)
BATCH = 16
"""Records written at a time."""
IDLE = 0.1
"""Rest when the queue is empty [s]: a wake costs more than a few records."""
BUSY = 0.001
"""Rest when more is waiting [s]."""
FLUSH = 0.25
"""Longest time between two flushes [s]: with the rests, a killed process loses less than 0.5 s."""


class Recorder(Protocol):
    """What the thread empties; `cloudrc.record.recorder` has it. No method raises."""

    def drain(self, max_records: int = ...) -> int:
        """Write out at most so many records; say how many were taken from the queue."""

    def flush(self, *, sync: bool = ...) -> None:
        """Hand what was written to the operating system."""

    def sync(self) -> bool:
        """Have what was flushed survive the machine; may take seconds. Say whether it does."""

    def close(self) -> None:
        """Write out the rest and end the file."""


class FlightsOnly:
    """Lets through what happens while the robot flies, and of the rest what is an event.

    A pod outlives its missions: 100 samples a second of a robot that keeps its place would fill
    its volume within hours.
    """

    def __init__(self, flies: Callable[[], bool]) -> None:
        """Begin with a robot that does not fly.

        Args:
            flies: Whether the robot follows the cloud.
        """
        self._flies = flies
        self._until_ns = 0

    def __call__(self, records: list[Record]) -> list[Record]:
        """Choose what is to be recorded."""
        if not records:
            return records
        stamp_ns = records[-1].stamp_ns
        if self._flies():
            self._until_ns = stamp_ns + AFTERWARDS_NS
        if stamp_ns <= self._until_ns:
            return records
        return [record for record in records if not isinstance(record, PERIODIC)]


class SyncAge:
    """What a power cut would take of a recording: all since the newest sync that is done began."""

    def __init__(self) -> None:
        """Begin with nothing that would be left."""
        self._safe: float | None = None

    def done(self, began: float) -> None:
        """Note that a sync which `began` then [s] is done."""
        self._safe = began

    def read(self, now: float) -> float | None:
        """Say how much is at risk `now` [s]; None if nothing is safe yet."""
        return None if self._safe is None else now - self._safe


class RecordingThread:
    """Runs a recorder in the background from `start` to `stop`."""

    def __init__(self, recorder: Recorder) -> None:
        """Make the thread; it does not run yet.

        Args:
            recorder: The loop puts into it; nobody else may drain it.
        """
        self._recorder = recorder
        self._stopping = threading.Event()
        # A daemon, so that a disk that hangs cannot keep the process from ending.
        self._thread = threading.Thread(target=self._run, name="recording", daemon=True)
        self._flushed, self._over = threading.Event(), False
        self._age = SyncAge()
        self._wall, self._steps = WallClock(), deque[float]()
        self._syncing = threading.Thread(target=self._sync, name="recording-sync", daemon=True)

    def start(self) -> None:
        """Begin to write."""
        self._thread.start()
        self._syncing.start()

    def sync_age(self) -> float | None:
        """Say for how long what is recorded is not safe yet [s]; None if nothing is."""
        return self._age.read(time.monotonic())

    def take_steps(self) -> list[float]:
        """Hand over by how much the wall clock was set, each time since the last call [s]."""
        return [self._steps.popleft() for _ in range(len(self._steps))]

    def stop(self, timeout: float = 1.5) -> bool:
        """Write out the rest, end the file and wait for that.

        Args:
            timeout: How long to wait [s].

        Returns:
            True if the file was ended in time.
        """
        self._stopping.set()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        recorder, rest = self._recorder, IDLE
        flushed = time.monotonic()
        while not self._stopping.wait(rest):
            rest = BUSY if recorder.drain(BATCH) == BATCH else IDLE
            now = time.monotonic()
            if now - flushed >= FLUSH:
                recorder.flush(sync=False)
                self._flushed.set()
                flushed = now
                if step := self._wall.step():
                    self._steps.append(step)
        recorder.close()
        self._over = True
        self._flushed.set()

    def _sync(self) -> None:
        while True:
            self._flushed.wait()
            self._flushed.clear()
            if self._over:
                return
            began = time.monotonic()
            if self._recorder.sync():
                self._age.done(began)
