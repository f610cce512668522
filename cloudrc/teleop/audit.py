"""Log commands as lines of JSON: who has sent them, and with which result.

A separate thread writes the lines, so that no request waits for the disk.
"""

from __future__ import annotations

import json
import logging
import os
import queue
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from io import TextIOWrapper
from logging.handlers import QueueHandler, QueueListener, RotatingFileHandler
from pathlib import Path
from typing import Any

SIZE_MAX = 8 << 20
"""Size at which the log file is closed and a new one begins [bytes]; the closed file replaces the
previous closed file."""


class Audit(RotatingFileHandler):
    """Write the audit log: two files of limited size that only their owner can read.

    Attributes:
        dropped: Number of lines that could not be written.
    """

    def __init__(self, path: Path, complain: Callable[[str], None]) -> None:
        """Start the thread; `complain` receives one line if the file cannot be written."""
        super().__init__(path, maxBytes=SIZE_MAX, backupCount=1, encoding="utf-8", delay=True)
        self.dropped, self._complain = 0, complain
        waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._queue, self._listener = QueueHandler(waiting), QueueListener(waiting, self)
        self._listener.start()

    def note(
        self, role: str, token: str, scope: Mapping[str, Any], answer: Mapping[str, Any]
    ) -> None:
        """Queue a line about a command for the writing thread.

        Args:
            role: Role of the caller.
            token: Name of the caller's token; the name does not reveal the token.
            scope: The request, as ASGI describes it.
            answer: Status and body of the answer.
        """
        said: Any = None
        with suppress(ValueError):
            said = json.loads(answer.get("body", b""))
        said = said if isinstance(said, dict) else {}
        line = {
            "time": datetime.now(UTC).isoformat(timespec="milliseconds"),
            "role": role,
            "token": token,
            "client": ":".join(map(str, scope.get("client") or ("local",))),
            "action": f"{scope['method']} {scope['path']}"[:200],
            "mission": said.get("id"),
            "status": answer["status"],
            "outcome": said.get("detail") or said.get("state") or "",
        }
        text = json.dumps(line, separators=(",", ":"))
        self._queue.handle(logging.makeLogRecord({"msg": text}))

    def stop(self) -> None:
        """Write the queued lines, and close the file."""
        self._listener.stop()
        with suppress(OSError):
            self.close()

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802
        """Count a lost line."""
        if not self.dropped:
            reason = sys.exception()
            self._complain(f"the audit log {self.baseFilename} cannot be written: {reason}")
        self.dropped += 1

    def _open(self) -> TextIOWrapper:
        return open(self.baseFilename, "a", encoding="utf-8", opener=_private)


def _private(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)
