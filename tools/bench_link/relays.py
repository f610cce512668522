"""The relays that are measured, each a process: ours, one in C, one with asyncio.

usage: python -m tools.bench_link.relays LISTEN_PORT TARGET_PORT DELAY   (the one with asyncio)
"""

from __future__ import annotations

import asyncio
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

from cloudrc.drivers.realtime import free_ports
from cloudrc.errors import MissingPrerequisiteError
from tools.bench_link.flow import Address, Array, Way

HERE = Path(__file__).parent
EMPTY: dict[str, object] = {"mission": "hover", "world": {"scene": "empty"}}
"""What an experiment of the bench flies, if it flew."""
DELAY = 0.020
"""Delay of the C relay and the asyncio relay, and of ours beside them [s]."""
_TICKS = os.sysconf("SC_CLK_TCK")


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
        """Return the processor time that it has taken [s]."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / _TICKS

    def memory(self) -> int:
        """Return the most memory that it has taken [bytes]."""
        status = Path(f"/proc/{self._process.pid}/status").read_text()
        found = re.search(r"VmHWM:\s+(\d+) kB", status)
        return int(found[1]) * 1024 if found else 0

    def use_fifo(self) -> None:
        """Put it under SCHED_FIFO."""
        os.sched_setscheduler(self._process.pid, os.SCHED_FIFO, os.sched_param(10))

    def stop(self) -> None:
        """End it."""
        self._process.send_signal(signal.SIGTERM)
        _, self.said = self._process.communicate(timeout=10)

    def counts(self) -> dict[str, float]:
        """Read what our relay has counted, once it has ended."""
        line = self.said.strip().splitlines()[-1].rpartition(": ")[2]
        return {name: float(n) for name, n in (one.split() for one in line.split(", "))}


def ours(folder: Path, link: dict[str, object], *flags: str) -> Process:
    """Start `cloudrc relay` on a link: the section `link` of an experiment file."""
    config = folder / f"{link.get('profile', 'link')}-{len(list(folder.iterdir()))}.yaml"
    config.write_text(json.dumps({"seed": 1, **EMPTY, "link": link}))
    world_side, cloud_side, world, cloud = _free_addresses(4)
    command = [sys.executable, "-m", "cloudrc", "relay", f"--config={config}", "--feed", *flags]
    addresses = {
        "world-side": world_side, "cloud-side": cloud_side, "world": world, "cloud": cloud
    }  # fmt: skip
    command += [f"--{name}={host}:{port}" for name, (host, port) in addresses.items()]
    return Process(
        command, [Way(True, world_side, cloud, world), Way(False, cloud_side, world, cloud)]
    )


def of_c(program: Path) -> Process:
    """Start the C relay."""
    listen, target = _free_addresses(2)
    command = [str(program), str(listen[1]), str(target[1]), str(round(DELAY * 1e6)), "1"]
    return Process(command, [Way(True, listen, target)])


def of_asyncio() -> Process:
    """Start the asyncio relay."""
    listen, target = _free_addresses(2)
    command = [sys.executable, "-m", __name__, str(listen[1]), str(target[1]), str(DELAY)]
    return Process(command, [Way(True, listen, target)])


def compile_anchors(folder: Path) -> tuple[Path, Path]:
    """Compile the programs `wake_lateness` and `relay` into a folder.

    Raises:
        MissingPrerequisiteError: If there is no C compiler, or it fails.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        raise MissingPrerequisiteError(
            "bench-link compiles two anchors and finds no C compiler 'cc'; apt-get install gcc"
        )
    for name in ("wake_lateness", "relay"):
        command = [compiler, "-O2", "-o", str(folder / name), str(HERE / "c" / f"{name}.c")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            line = (done.stderr.strip().splitlines() or ["no message"])[0]
            raise MissingPrerequisiteError(f"cc cannot compile {name}.c: {line}; see its packages")
    return folder / "wake_lateness", folder / "relay"


def wake_lateness(program: Path, count: int, *, fifo: bool) -> Array:
    """Let C sleep until instants 1 ms apart; return how late it woke [s], shape (count,)."""
    command = [*(("chrt", "-f", "10") if fifo else ()), str(program), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return np.array(done.stdout.split(), dtype=float) * 1e-9


def fifo_allowed() -> bool:
    """Say whether this user may run programs under SCHED_FIFO."""
    if shutil.which("chrt") is None:
        return False
    done = subprocess.run(["chrt", "-f", "10", "true"], capture_output=True, check=False)
    return done.returncode == 0


def _free_addresses(count: int) -> list[Address]:
    return [("127.0.0.1", port) for port in free_ports(count)]


class _AsyncioRelay(asyncio.DatagramProtocol):
    """A relay with `call_later`, whose clock epoll rounds up to 1 ms."""

    def __init__(self, target: Address, delay: float) -> None:
        self._target, self._delay = target, delay

    def connection_made(self, transport: Any) -> None:
        self._transport, self._loop = transport, asyncio.get_running_loop()

    def datagram_received(self, data: bytes, addr: tuple[str | int, int]) -> None:
        self._loop.call_later(self._delay, self._transport.sendto, data, self._target)


async def _relay_with_asyncio(listen: int, target: int, delay: float) -> None:
    await asyncio.get_running_loop().create_datagram_endpoint(
        lambda: _AsyncioRelay(("127.0.0.1", target), delay), local_addr=("127.0.0.1", listen)
    )
    print("ready", flush=True)
    await asyncio.Event().wait()


if __name__ == "__main__":
    asyncio.run(_relay_with_asyncio(int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])))
