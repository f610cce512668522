"""The relays that are measured, each a process of its own: ours, one in C, one with asyncio."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

from cloudrc.drivers.realtime import free_ports
from tools.bench_link.flow import Address, Way

HERE = Path(__file__).parent
DELAY = 0.020
"""Of the C relay and the asyncio relay, and of ours beside them [s]."""
_TICKS = os.sysconf("SC_CLK_TCK")


def free_addresses(count: int) -> list[Address]:
    """UDP addresses on 127.0.0.1 that nobody uses now."""
    return [("127.0.0.1", port) for port in free_ports(count)]


class Process:
    """A relay that runs.

    Attributes:
        ways: How to send through it.
        said: What it wrote to standard error, once it has ended.
    """

    def __init__(self, command: list[str], ways: list[Way]) -> None:
        """Start it and wait until it says that it is ready."""
        self.ways, self.said = ways, ""
        self._process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert self._process.stdout is not None
        self._process.stdout.readline()

    def cpu(self) -> float:
        """How much processor time it has taken [s]."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS

    def memory(self) -> int:
        """How much memory it has taken at most [bytes]."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+) kB", status)
        return int(found[1]) * 1024 if found else 0

    def run_first(self) -> bool:
        """Put it under SCHED_FIFO; False if this user may not."""
        try:
            os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(10))
        except PermissionError:
            return False
        return True

    def stop(self) -> str:
        """End it, and give back what it said."""
        self._process.send_signal(signal.SIGTERM)
        _, said = self._process.communicate(timeout=10)
        self.said = said
        return self.said

    def counts(self) -> dict[str, float]:
        """Read what our relay has counted, once it has ended."""
        line = self.said.strip().splitlines()[-1].rpartition(": ")[2]
        return {name: float(n) for name, n in (one.split() for one in line.split(", "))}


def ours(folder: Path, link: dict[str, object], *flags: str) -> Process:
    """Start `cloudrc relay` on a link: the section `link` of an experiment file."""
    config = folder / f"{link.get('profile', 'link')}-{len(list(folder.iterdir()))}.yaml"
    config.write_text(json.dumps({"seed": 1, "mission": "hover", "link": link}))
    world_side, cloud_side, world, cloud = free_addresses(4)
    command = [sys.executable, "-m", "cloudrc", "relay", "--config", str(config), "--feed", *flags]
    for flag, (host, port) in (
        ("--world-side", world_side),
        ("--cloud-side", cloud_side),
        ("--world", world),
        ("--cloud", cloud),
    ):
        command.append(f"{flag}={host}:{port}")
    ways = [Way(True, world_side, cloud), Way(False, cloud_side, world)]
    return Process(command, ways)


def of_c(program: Path, *, stamps: bool) -> Process:
    """Start the C relay."""
    listen, target = free_addresses(2)
    delay = str(round(DELAY * 1e6))
    command = [str(program), str(listen[1]), str(target[1]), delay, str(int(stamps))]
    return Process(command, [Way(True, listen, target)])


def of_asyncio() -> Process:
    """Start the asyncio relay."""
    listen, target = free_addresses(2)
    command = [sys.executable, str(HERE / "asyncio_relay.py")]
    command += [str(listen[1]), str(target[1]), str(DELAY)]
    return Process(command, [Way(True, listen, target)])
