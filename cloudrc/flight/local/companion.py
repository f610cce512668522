# SPDX-License-Identifier: Apache-2.0

"""Start a program of the user with a flight, and end it with the flight."""

from __future__ import annotations

import http.client
import os
import shlex
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from urllib.parse import urlsplit

from cloudrc.base.errors import ControllerLostError, to_one_line
from cloudrc.flight.machine import await_or_kill, signal_group
from cloudrc.wire.records import CONTROLLER_LOST

LOG_FILE = "with.log"
"""File in the run's folder: what the program prints."""
START_LIMIT = 60.0
"""Time limit for the program to listen [s]: it may load weights."""
STOP_LIMIT = 1.5
"""Time limit for the program to end after SIGTERM [s]; then it is killed."""
LOOK_PERIOD = 0.1
"""Time between two looks whether the program listens [s]."""


@contextmanager
def companion(command: str, folder: Path, url: str = "") -> Iterator[Callable[[], bool]]:
    """Run `command` during the block; its output goes to `LOG_FILE` in `folder`.

    The yielded function returns whether the program and all its children have ended.

    With `url`, the address of a policy's server, first wait until somebody listens there. At the
    end of the block, the program and all its children are ended.

    Raises:
        ControllerLostError: If nobody listens in time, or if the block raises it. Its text tells
            whether the program has ended.
    """
    log = folder / LOG_FILE
    program = _start(command, log)
    try:
        if url:
            _wait_for(url, program, log)
        yield lambda: _has_ended(program)
    except ControllerLostError as error:
        if (code := program.poll()) is None:
            raise
        raise ControllerLostError(error.code, f"{error}; {_how(code, log)}") from None
    finally:
        _end(program)


def _start(command: str, log: Path) -> subprocess.Popen[bytes]:
    with log.open("wb") as output:
        output.write(f"$ {command}\n".encode(errors="replace"))
        output.flush()
        return subprocess.Popen(
            shlex.split(command),
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # its children are in its group, which is ended
        )


def _wait_for(url: str, program: subprocess.Popen[bytes], log: Path) -> None:
    deadline = time.monotonic() + START_LIMIT
    while not _listens(url):
        if program.poll() is not None:
            raise ControllerLostError(CONTROLLER_LOST[0], f"{url}: nobody listens there")
        if time.monotonic() >= deadline:
            text = f"{url}: nobody listens there {START_LIMIT:g} s after the start of the program"
            raise ControllerLostError(CONTROLLER_LOST[0], f"{text} of --with; see {log}")
        time.sleep(LOOK_PERIOD)


def _listens(url: str) -> bool:
    """Return whether somebody accepts connections, whatever the answer is."""
    parts = urlsplit(url)
    port = parts.port or (443 if parts.scheme == "wss" else 80)
    with closing(http.client.HTTPConnection(parts.hostname or "", port, timeout=1.0)) as asked:
        try:
            asked.connect()
        except OSError:
            return False
        with suppress(OSError, http.client.HTTPException):
            asked.request("GET", "/healthz")
            asked.getresponse().read()
    return True


def _how(code: int, log: Path) -> str:
    _, *said = log.read_text(errors="replace").strip().splitlines()  # without the command
    how = f"signal {-code}" if code < 0 else f"exit code {code}"
    text = f": {to_one_line(said[-1])}" if said else " without a word"
    return f"the program of --with has ended ({how}){text}; see {log}"


def _has_ended(program: subprocess.Popen[bytes]) -> bool:
    """Return whether nothing of the program's group runs: a program may leave its children."""
    if program.poll() is None:
        return False
    try:
        os.killpg(program.pid, 0)
    except ProcessLookupError:
        return True
    return False


def _end(program: subprocess.Popen[bytes]) -> None:
    """End the program and its group; its children may outlive it."""
    signal_group(program, signal.SIGTERM)
    await_or_kill(program, STOP_LIMIT)
    signal_group(program, signal.SIGKILL)
