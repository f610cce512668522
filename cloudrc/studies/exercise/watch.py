# SPDX-License-Identifier: Apache-2.0

"""Watch the processes of a part: it and its children share limits, and end together.

On Linux, a child whose parent has ended becomes a child of the process that watches, so that it is
found even if it has left the process group. Other systems show no such children; there, the limits
of memory and processes do not hold.
"""

from __future__ import annotations

import ctypes
import os
import re
import resource
import select
import signal
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

PERIOD_MS = 50
"""Time between two looks [ms]."""
GRACE = 2.0
"""Longest time in which a part that ends says where it is [s]."""
PROC = "/proc"
SUBREAPER = 36
"""PR_SET_CHILD_SUBREAPER. Source: prctl(2)."""
RESIDENT = re.compile(r"^Vm(?:RSS|Swap):\s+(\d+) kB", re.MULTILINE)
PROPORTIONAL = re.compile(r"^(?:Pss|SwapPss):\s+(\d+) kB", re.MULTILINE)
WRITABLE = re.compile(r"^VmData:\s+(\d+) kB", re.MULTILINE)


class Limits(NamedTuple):
    """Limits of each part.

    Attributes:
        seconds: Processor time of each process [s]; the solution needs 5 s.
        memory: Memory of the part and its children together [bytes].
        processes: Largest number of processes at once: the part and its children.
        patience: Last resort: the part ends after `seconds` times this number, in real time [1].
    """

    seconds: int = 60
    memory: int = 2 << 30
    processes: int = 64
    patience: float = 10.0

    @property
    def memory_text(self) -> str:
        """What a part did that went beyond the limit of memory."""
        return f"used more than {self.memory / 2**30:.3g} GiB"


LIMITS = Limits()
"""The default limits."""


def adopt() -> None:
    """Let this process become the parent of its descendants whose own parents have ended."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(SUBREAPER, 1, 0, 0, 0)


def watch(worker: int, limits: Limits) -> str:
    """Return once a part ends, breaks a limit, or the check closes its end of stdin.

    Return which limit the part broke; "" for none. `worker` is the part's process, a child.
    """
    check = select.poll()
    check.register(0, 0)  # an end that closes is always reported
    while not check.poll(PERIOD_MS):
        for process, status, used in _ended():
            if process == worker:
                killed = status == signal.SIGKILL and used.ru_utime + used.ru_stime
                late = status == signal.SIGXCPU or killed >= limits.seconds
                return f"no end after {limits.seconds} s of processor time" if late else ""
        part = _descendants()
        if len(part) > limits.processes:
            return f"started more than {limits.processes} processes"
        if _is_above(part, limits.memory):
            return limits.memory_text
    return ""


def end(worker: int) -> None:
    """End a part and all its descendants; first give the `worker` time to say where it is."""
    _send(signal.SIGKILL, {*_descendants()} - {worker})
    _send(signal.SIGXCPU, [worker])
    _send(signal.SIGCONT, [worker])
    until = time.monotonic() + GRACE
    while time.monotonic() < until and worker not in [ended for ended, *_ in _ended()]:
        if not _has_children():
            return
        time.sleep(0.01)
    while _has_children():
        _send(signal.SIGKILL, {*_descendants(), worker})
        for _ in _ended():
            pass
        time.sleep(0.002)


def limit_memory(size: int) -> None:
    """Let this process, and each child, allocate at most `size` [bytes] more: else a MemoryError.

    The limit is that of written data. One of all addresses would count libraries that are only
    mapped, and the reserves of threads, of which a computer with many cores has gigabytes.
    """
    if now := sum(_numbers("self", "status", WRITABLE)):
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        soft = now + size if hard == resource.RLIM_INFINITY else min(now + size, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def _ended() -> Iterator[tuple[int, int, Any]]:
    """Yield process, status and used resources of each child that has ended."""
    with suppress(ChildProcessError):
        while (found := os.wait4(-1, os.WNOHANG))[0]:
            yield found


def _has_children() -> bool:
    try:
        os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    except ChildProcessError:
        return False
    return True


def _send(number: int, processes: Iterable[int]) -> None:
    for process in processes:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(process, number)


def _descendants() -> list[int]:
    """Return the children of this process, their children, and so on."""
    found = [os.getpid()]
    for process in found:  # grows meanwhile
        with suppress(OSError):
            for thread in os.listdir(f"{PROC}/{process}/task"):
                found += map(int, _read(f"{process}/task/{thread}/children").split())
    return found[1:]


def _read(name: str) -> str:
    """Return the text of a file below /proc, "" if the process has ended."""
    try:
        with open(f"{PROC}/{name}", encoding="ascii", errors="replace") as file:
            return file.read()
    except OSError:
        return ""


def _is_above(processes: Sequence[int], limit: int) -> bool:
    """Return whether the memory of processes is above `limit` [bytes].

    Pages that forks share count once. To know them takes the kernel long, so the processes stop
    meanwhile, and only if the sum that counts such pages in each process is above the limit.
    """
    if _sum(processes, "status", RESIDENT) <= limit:
        return False
    _send(signal.SIGSTOP, processes)
    above = _sum(processes, "smaps_rollup", PROPORTIONAL) > limit
    if not above:
        _send(signal.SIGCONT, processes)
    return above


def _sum(processes: Iterable[int], file: str, pattern: re.Pattern[str]) -> int:
    """Return the sum of sizes [bytes] of processes, from a file of the kernel."""
    return sum(size for process in processes for size in _numbers(process, file, pattern))


def _numbers(process: int | str, file: str, pattern: re.Pattern[str]) -> Iterator[int]:
    """Yield sizes [bytes] of a process from a file of the kernel."""
    for size in pattern.findall(_read(f"{process}/{file}")):
        yield int(size) << 10
