"""Signals: SIGHUP and SIGTERM act like Ctrl-C, except under `nohup`; workers end, too."""

import os
import select
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.cli.pool import _hung_up, interrupt_on_signals


@pytest.fixture(autouse=True)
def not_ignored():
    """Start with the default handler, as in a terminal; conftest.py restores the old one."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def test_only_the_first_hang_up_interrupts():
    interrupt_on_signals()
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGHUP)
    os.kill(os.getpid(), signal.SIGHUP)
    with pytest.raises(KeyboardInterrupt):  # a second request still counts
        os.kill(os.getpid(), signal.SIGTERM)


def test_under_nohup_a_hang_up_is_ignored():
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    interrupt_on_signals()
    os.kill(os.getpid(), signal.SIGHUP)


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--seeds", "2", "--mode", "local"],
        ["mission", "fly", "--mission", "none.yaml", "--api", "http://127.0.0.1:9"],
        ["link", "verify", "none"],
    ],
)
def test_flying_commands_treat_a_hang_up_as_ctrl_c(words):
    assert main(words) == 2
    assert signal.getsignal(signal.SIGHUP) is _hung_up


@pytest.mark.process
@pytest.mark.parametrize(
    "words",
    [["faults", "search", "--minutes", "9", "--jobs", "2"], ["run", "steps", "--seeds", "9"]],
)
def test_workers_end_if_their_parent_is_killed(words, tmp_path):
    command = [sys.executable, "-m", "cloudrc", *words]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE) as first:
        assert first.stdout is not None
        children = Path(f"/proc/{first.pid}/task/{first.pid}/children")
        until = time.monotonic() + 60.0
        while len(workers := children.read_text().split()) < 2:
            assert first.poll() is None
            assert time.monotonic() < until
            time.sleep(0.1)
        time.sleep(3.0)  # until they are flying
        first.kill()
        first.wait()
        while select.select([first.stdout], [], [], 20.0)[0]:  # ends once all workers have ended
            if not first.stdout.read1():
                return
    for worker in workers:
        with suppress(ProcessLookupError):
            os.kill(int(worker), signal.SIGKILL)
    pytest.fail("workers still wait for work")
