# SPDX-License-Identifier: Apache-2.0

"""A process of a local run, which the supervisor starts, hears and ends."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cloudrc.flight.machine import interpreter
from cloudrc.flight.pod.process import PARENT, READY, from_line
from cloudrc.wire.records import Record

CONTROLLER = "controller"
"""Name of the process that asks a controller outside."""


@dataclass
class Child:
    """A process of a local run, such as world, which the supervisor has started."""

    name: str  # "world", "cloud", "teleop", "uplink" or "downlink"; in a fleet "robot-0/world"
    process: subprocess.Popen[bytes]
    log: Path  # file with the process's standard error
    unread: bytes = b""  # start of a line of output whose end has not arrived yet
    heard: float = 0.0  # time at which the last line arrived [s], the run's clock
    ready: bool = False  # whether the process can receive datagrams

    @property
    def is_teleop(self) -> bool:
        """Whether it commands a robot, and ends after the mission."""
        return self.log.stem == "teleop"

    def take(self, data: bytes, now: float) -> list[Record]:
        """Parse output that arrives at `now` [s]; return the records in complete lines."""
        records: list[Record] = []
        *lines, self.unread = (self.unread + data).split(b"\n")
        for line in lines:
            self.heard = now
            if line == READY.encode():
                self.ready = True
            else:
                records.append(from_line(line.decode()))
        return records


def start_process(
    words: Sequence[str], options: Mapping[str, object], output: int | IO[bytes], log: IO[bytes]
) -> subprocess.Popen[bytes]:
    """Start `cloudrc WORDS` with the flags `--NAME=VALUE` of `options`.

    The process writes its errors to `log`, and ends if this process ends.
    """
    flags = [f"--{name}={value}" for name, value in options.items()]
    return subprocess.Popen(
        interpreter("-m", "cloudrc", *words, *flags),
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=log,
        env={**os.environ, PARENT: str(os.getpid())},
        start_new_session=True,  # Ctrl-C reaches only this process, which ends its children
    )
