"""What all tests share: the signals of a terminal, however the tests themselves were started."""

from __future__ import annotations

import signal

# A shell that starts the tests in the background lets them ignore Ctrl-C, and so would all the
# processes that they start, though to end on Ctrl-C is what some of these are tested for.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
