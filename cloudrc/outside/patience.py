"""Tell what takes long, while it takes long."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SILENT = 3.0
"""Time after which the log names what a command waits for [s]."""


@contextmanager
def telling_if_slow(text: str, silent: float | None = None) -> Iterator[None]:
    """Log `text` if the block takes longer than `silent` [s] (SILENT), while it runs."""
    silent = SILENT if silent is None else silent
    timer = threading.Timer(silent, logging.getLogger("cloudrc").warning, ("%s", text))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
