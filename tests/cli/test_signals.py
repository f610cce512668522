"""A terminal that is closed ends a command as Ctrl-C does, unless `nohup` has started it.

Its workers end with it, however it ends.
"""

from __future__ import annotations

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
from cloudrc.cli.pool import _hung_up, end_orderly


@pytest.fixture(autouse=True)
def not_ignored() -> None:
    """Begin as a program in a terminal does; conftest.py gives back what was before."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def test_the_first_hang_up_interrupts_and_those_after_it_do_not() -> None:
    end_orderly()
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGHUP)
    os.kill(os.getpid(), signal.SIGHUP)
    with pytest.raises(KeyboardInterrupt):  # who asks again means it
        os.kill(os.getpid(), signal.SIGTERM)


def test_who_was_started_by_nohup_hears_of_no_hang_up() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    end_orderly()
    os.kill(os.getpid(), signal.SIGHUP)


@pytest.mark.parametrize(
    "words",
    [
        ["run", "--seeds", "2", "--mode", "local"],
        ["mission", "fly", "--mission", "none.yaml", "--api", "http://127.0.0.1:9"],
        ["link", "verify", "none"],
    ],
)
def test_who_flies_takes_a_hang_up_for_an_interrupt(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert signal.getsignal(signal.SIGHUP) is _hung_up


@pytest.mark.process
@pytest.mark.parametrize(
    "words", [["faults", "fuzz", "--seeds", "99", "--jobs", "2"], ["run", "steps", "--seeds", "9"]]
)
def test_workers_end_though_what_has_started_them_was_killed(
    words: list[str], tmp_path: Path
) -> None:
    command = [sys.executable, "-m", "cloudrc", *words]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE) as first:
        assert first.stdout is not None
        children = Path(f"/proc/{first.pid}/task/{first.pid}/children")
        until = time.monotonic() + 60.0
        while len(workers := children.read_text().split()) < 2:
            assert first.poll() is None
            assert time.monotonic() < until
            time.sleep(0.1)
        time.sleep(3.0)  # they fly
        first.kill()
        first.wait()
        while select.select([first.stdout], [], [], 20.0)[0]:  # nobody else can write to it
            if not first.stdout.read1():
                return
    for worker in workers:
        with suppress(ProcessLookupError):
            os.kill(int(worker), signal.SIGKILL)
    pytest.fail("they wait for work")
