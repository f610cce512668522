# SPDX-License-Identifier: Apache-2.0

"""Tell what takes long, while it takes long."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import contextmanager

SILENT = 3.0
"""Time after which the log names what a command waits for [s]."""


@contextmanager
def telling_if_slow(text: str) -> Iterator[None]:
    """Log `text` if the block takes longer than `SILENT`, while it runs."""
    timer = threading.Timer(SILENT, logging.getLogger("cloudrc").warning, ("%s", text))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
