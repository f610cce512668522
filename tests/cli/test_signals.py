"""A terminal that is closed ends a command as Ctrl-C does, unless `nohup` has started it."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from cloudrc.cli.main import main
from cloudrc.cli.signals import _hung_up, end_orderly


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
    ],
)
def test_who_flies_takes_a_hang_up_for_an_interrupt(
    words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words) == 2
    assert signal.getsignal(signal.SIGHUP) is _hung_up
