# SPDX-License-Identifier: Apache-2.0

"""Ask a program outside for commands: in lock step in virtual time, in a process in real time.

In real time the process of cloud does no foreign I/O. It exchanges datagrams with a driver process
beside it over Unix sockets, and the driver asks the program, one observation at a time. Cloud flies
the newest answer, row by row, until `HOLD` after the end of its rows.
"""

from __future__ import annotations

import os
import select
import threading
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from cloudrc.base.errors import CloudrcError, ControllerLostError
from cloudrc.flight.pod.openpi import KEY_VARIABLE
from cloudrc.flight.pod.openpi.actions import ACTIONS, PolicyAnswerError, read_actions
from cloudrc.flight.pod.openpi.client import PolicyClient, SilentServerError
from cloudrc.flight.pod.openpi.codec import pack, unpack
from cloudrc.flight.pod.teleop_link import UnixDatagrams
from cloudrc.wire.records import CONTROLLER_LOST

WIDTH = 4
"""Numbers of a row: vx, vy, vz [m/s], yaw rate [rad/s]."""
ROWS_MAX = 256
"""Largest number of rows of an answer that cloud uses."""
DATAGRAM_MAX = 16_384
"""Size limit of a datagram between cloud and the driver [bytes]; all are smaller."""
VIRTUAL_LIMIT = 2.0
"""Wall time for an answer in virtual time, after the first answer [s]."""
HOLD = 0.2
"""Time after the end of an answer's rows for which its last row is flown, in real time [s]."""
HOLD_NS = round(HOLD * 1e9)
ENDED_LIMIT = 0.5
"""Time limit for the first answer if the program of `--with` has ended, in real time [s]."""
SILENCE = 5.0
"""Time without a valid answer after which the flight ends, in real time [s]."""
PAUSE_NS = 100_000_000
"""Time between two observations after which the loop has paused, for example because it was frozen
[ns]: the program was not silent in this time."""
RETRY_PERIOD = 0.05
"""Time between two attempts to reach a program that is gone [s]."""
WAKE = 0.1
"""Longest time for which the driver waits for a datagram [s]."""
SILENT, INVALID = CONTROLLER_LOST
"""Codes of a lost controller."""


def check() -> None:
    """Raise nothing: the extra `policy` is all that this transport needs."""


def lock_step(url: str, start_limit: float, gone: Callable[[], bool]) -> LockStep:
    """Connect to the program at `url` in virtual time; wait `start_limit` [s] for an answer."""
    return LockStep(url, start_limit)


def driver(
    peer: UnixDatagrams, url: str, start_limit: float, tell: Callable[[str], None]
) -> RemoteDriver:
    """Connect to the program at `url` in real time; wait `start_limit` [s] for an answer."""
    return RemoteDriver(peer, url, start_limit)


class LockStep:
    """The way to the program in virtual time, which stands still until the answer has arrived."""

    def __init__(self, url: str, start_limit: float) -> None:
        """Connect to `url`; `start_limit` is the time limit for the first answer [s].

        Raise a ControllerLostError if this fails.
        """
        self._url, self._start_limit = url, start_limit
        self._used = False
        self._client = self._connect()

    def close(self) -> None:
        """Leave the program."""
        self._client.close()

    def begin(self) -> None:
        """Begin an episode: a new connection, unless no observation was sent on this one."""
        if self._used:
            self._client.close()
            self._client, self._used = self._connect(), False

    def exchange(self, observation: dict[str, Any]) -> tuple[float, list[list[float]]]:
        """Return the age of the observation, 0 s, and the rows of the answer."""
        self._used = True
        try:
            return 0.0, _rows(self._client.infer(observation))
        except CloudrcError as error:
            raise _lost(error) from None
        except PolicyAnswerError as error:
            raise ControllerLostError(INVALID, f"{self._url}: {error}") from None

    def _connect(self) -> PolicyClient:
        try:
            return _connect(self._url, self._start_limit, VIRTUAL_LIMIT)
        except CloudrcError as error:
            raise _lost(error) from None


def _connect(url: str, start_limit: float, answer_limit: float) -> PolicyClient:
    key = os.environ.get(KEY_VARIABLE, "")
    return PolicyClient(url, key=key, start_limit=start_limit, answer_limit=answer_limit)


def _lost(error: CloudrcError) -> ControllerLostError:
    code = SILENT if isinstance(error, SilentServerError) else INVALID
    return ControllerLostError(code, str(error))


def _rows(answer: dict[Any, Any]) -> list[list[float]]:
    """Return the rows of an answer; none if its actions are nil: cloud is to send nothing."""
    if ACTIONS in answer and answer[ACTIONS] is None:
        return []
    rows: list[list[float]] = read_actions(answer, WIDTH)[:ROWS_MAX].astype(float).tolist()
    return rows


class RemoteLink:
    """The way to the program in real time, as cloud's process sees it: datagrams to the driver."""

    def __init__(self, peer: UnixDatagrams, period: float, start_limit: float) -> None:
        """Exchange datagrams with `peer`.

        `period` is the time between two commands, `start_limit` the time limit for the first answer
        of an episode, both [s].
        """
        self._peer, self._period_ns = peer, round(period * 1e9)
        self._start_limit = start_limit
        self._episode, self._trouble, self._has_ended = 0, "", False
        self._forget()

    def _forget(self) -> None:
        self._newest: tuple[int, list[list[float]]] | None = None  # time of the observation [ns]
        self._asked_ns = self._flown_ns = 0  # last observation; last flown answer [ns]
        self._is_flown = True  # whether cloud has used the newest answer

    def begin(self) -> None:
        """Begin an episode: answers to earlier observations no longer count."""
        if self._asked_ns:
            self._episode += 1
        self._forget()

    def exchange(self, observation: dict[str, Any]) -> tuple[float, list[list[float]]] | None:
        """Send an observation; return the newest answer and its age [s] if it may be flown."""
        now_ns = time.monotonic_ns()
        paused_ns = now_ns - self._asked_ns
        if not self._asked_ns:
            self._flown_ns = now_ns
        elif paused_ns > PAUSE_NS:
            self._flown_ns += paused_ns
        self._asked_ns = now_ns
        message = {"episode": self._episode, "sent_ns": now_ns, "observation": observation}
        self._peer.send_data(pack(message))
        for data in self._peer.receive_data():
            self._take(unpack(data))
        if self._newest is not None:
            sent_ns, rows = self._newest
            if now_ns - sent_ns <= len(rows) * self._period_ns + HOLD_NS:
                self._flown_ns, self._is_flown = now_ns, True
                return (now_ns - sent_ns) * 1e-9, rows
        self._check_silence((now_ns - self._flown_ns) * 1e-9)
        return None

    def _take(self, message: dict[str, Any]) -> None:
        self._has_ended |= "ended" in message
        if message.get("episode") != self._episode:
            return
        if text := message.get("invalid"):
            raise ControllerLostError(INVALID, text)
        self._trouble = message.get("trouble", "")
        known_ns = self._newest[0] if self._newest is not None else 0
        if "rows" in message and message["sent_ns"] > known_ns:
            rows = message["rows"]
            if rows or self._is_flown:  # an answer without rows replaces none that is to be flown
                self._newest, self._is_flown = (message["sent_ns"], rows), False

    def _check_silence(self, silence: float) -> None:
        """Raise a ControllerLostError if no answer was flown for `silence` [s], which is long."""
        limit = SILENCE
        if self._newest is None:
            limit = ENDED_LIMIT if self._has_ended else self._start_limit
        if silence > limit:
            why = f": {self._trouble}" if self._trouble else "; is the program too slow?"
            text = f"the remote controller gave no answer in time for {limit:g} s{why}"
            raise ControllerLostError(SILENT, text)


class RemoteDriver:
    """Asks the program in real time, in a process of its own beside cloud."""

    def __init__(self, peer: UnixDatagrams, url: str, start_limit: float) -> None:
        """Connect to `url`; raise a PolicyServerError if that fails.

        `start_limit` is the time limit for the first answer of an episode [s].
        """
        self._peer, self._url, self._start_limit = peer, url, start_limit
        self._episode = 0
        self._client: PolicyClient | None = self._connect()
        self._waiting = SimpleQueue[bytes]()

    def run(self, stop: Callable[[], bool]) -> None:
        """Answer cloud until `stop()` is true; an answer may take longer than the wait for it."""
        threading.Thread(target=self._work, daemon=True).start()
        while not stop():
            if select.select([self._peer], [], [], WAKE)[0]:
                for data in self._peer.receive_data():
                    self._waiting.put(data)

    def _work(self) -> None:
        while True:
            data = self._waiting.get()
            while not self._waiting.empty():  # only the newest observation counts
                data = self._waiting.get()
            message = unpack(data)
            answer = self._ask(message["episode"], message["observation"])
            self._peer.send_data(
                pack({"episode": message["episode"], "sent_ns": message["sent_ns"], **answer})
            )

    def _ask(self, episode: int, observation: dict[str, Any]) -> dict[str, Any]:
        if episode != self._episode:
            self._leave()
            self._episode = episode
        try:
            if self._client is None:
                self._client = self._connect()
            return {"rows": _rows(self._client.infer(observation))}
        except SilentServerError as error:  # it may come back
            self._leave()
            time.sleep(RETRY_PERIOD)
            return {"trouble": str(error)}
        except (CloudrcError, PolicyAnswerError) as error:
            self._leave()
            text = str(error)
            return {"invalid": text if self._url in text else f"{self._url}: {text}"}

    def _leave(self) -> None:
        if self._client is not None:
            self._client.close()
        self._client = None

    def _connect(self) -> PolicyClient:
        return _connect(self._url, self._start_limit, SILENCE)


def tell_ended(folder: Path) -> None:
    """Tell cloud that the program of `--with` has ended; `folder` is as in `sockets_of`."""
    cloud, _ = sockets_of(folder)
    with closing(UnixDatagrams(folder / "supervisor.sock", cloud)) as peer:
        peer.send_data(pack({"ended": True}))


def sockets_of(folder: Path) -> tuple[Path, Path]:
    """Return the sockets of cloud and of the driver in the folder of a run's sockets."""
    return folder / "remote-cloud.sock", folder / "remote.sock"
