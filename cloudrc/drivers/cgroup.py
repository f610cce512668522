"""CPU throttling of this container: the kernel's cpu.stat comes in, counts and seconds go out."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

ROOT = Path("/sys/fs/cgroup")
STATS = ("cpu.stat", "cpu/cpu.stat", "cpu,cpuacct/cpu.stat")
"""Version 2 first; the others are mounts of version 1. A container sees its own group there."""


class Throttling(NamedTuple):
    """What the CPU limit has done so far.

    Attributes:
        periods: CFS periods in which something wanted to run.
        throttled: Those of them in which it was stopped.
        seconds: For how long, over all CPUs [s].
    """

    periods: int
    throttled: int
    seconds: float


def read_throttling(root: Path = ROOT) -> Throttling | None:
    """Read the counts; None where the kernel keeps none, as outside of containers.

    Source: Linux, Documentation/admin-guide/cgroup-v2.rst (throttled_usec, in us) and
    Documentation/scheduler/sched-bwc.rst (throttled_time of version 1, in ns).
    """
    for name in STATS:
        try:
            text = (root / name).read_text()
        except OSError:
            continue
        pairs = (line.split() for line in text.splitlines())
        stat = {key: int(value) for key, value in pairs}
        if "nr_periods" in stat:
            seconds = stat.get("throttled_usec", 0) * 1e-6 + stat.get("throttled_time", 0) * 1e-9
            return Throttling(stat["nr_periods"], stat["nr_throttled"], seconds)
    return None
