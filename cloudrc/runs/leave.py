"""End a process although users' code has left a thread running."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import suppress

PATIENCE = 2.0
"""Time that threads have at the end of a process [s]."""


def limit_exit(code: int) -> None:
    """End this process with the exit code `code` soon, even if threads never end.

    Call it last: Python then waits for all threads, without a limit of time.
    """
    signal.setitimer(signal.ITIMER_REAL, 0.0)  # a plug-in's timer would change the exit code
    others = {*threading.enumerate()} - {threading.current_thread()}
    if all(each.daemon for each in others):
        return
    for number in (signal.SIGINT, signal.SIGTERM):  # the command's work is done
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)

    def end() -> None:
        text = "cloudrc: warning: a plug-in has left a thread running; it was ended"
        with suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)
            sys.stdout.flush()
        os._exit(code)

    timer = threading.Timer(PATIENCE, end)
    timer.daemon = True
    timer.start()
