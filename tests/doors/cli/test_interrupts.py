# SPDX-License-Identifier: Apache-2.0

"""SIGINT, SIGTERM and SIGHUP interrupt a command; none gets lost in an import or a library.

MuJoCo turns every exception in its import into an ImportError, so that a sweep stored rows with the
verdict `error` and ended as if it was done.
"""

import os
import signal
from pathlib import Path

import pytest

from cloudrc.flight.interrupts import interrupt_on_signals
from cloudrc.flight.trials.plan import PlannedFlight
from cloudrc.flight.trials.rows import read_rows

pytestmark = pytest.mark.child
SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


@pytest.fixture(autouse=True)
def a_terminal(one_core):
    for number in SIGNALS:  # tests/conftest.py restores them
        signal.signal(number, signal.SIG_DFL)


def test_only_the_first_hang_up_interrupts():
    interrupt_on_signals()
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGHUP)
    os.kill(os.getpid(), signal.SIGHUP)
    with pytest.raises(KeyboardInterrupt):  # a second request still counts
        os.kill(os.getpid(), signal.SIGTERM)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as under nohup
    interrupt_on_signals()
    os.kill(os.getpid(), signal.SIGHUP)


def swallow(flight):
    """Get a signal as in an import of MuJoCo that turns it into an error, and return a row."""
    try:
        os.kill(os.getpid(), signal.SIGTERM)
    except KeyboardInterrupt:
        text = "MissingPrerequisiteError: the simulator needs MuJoCo (initialization failed)"
        found = {"verdict": "error", "failures": ["error"], "text": text}
        return flight.row({**found, "numbers": {}, "records_sha256": ""})


def test_a_sweep_stores_no_row_after_a_signal_that_a_library_caught(write_sweep, monkeypatch, call):
    monkeypatch.setattr(PlannedFlight, "play", swallow)
    error = call("sweep run --out grid", write_sweep(), code=130).err
    assert "cloudrc: interrupted; to continue" in error
    assert read_rows(Path("grid")) == {}
