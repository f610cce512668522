"""A search sums up its flights; told to stop, it sums up those flown and says how to go on."""

from __future__ import annotations

import json
import multiprocessing.context
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from cloudrc.cli import faults_fuzz
from cloudrc.cli.main import main
from cloudrc.faults.fuzz import Finding
from cloudrc.faults.invariants import Breach
from cloudrc.faults.schedule import Schedule

Fuzz = Callable[..., tuple[dict[str, Any], str]]
BAD = 7
"""The seed whose flight breaks an invariant."""


def _fly(schedule: Schedule, keep: bool = False) -> Finding:
    """As good as a flight: what it shows depends on the seed."""
    seed = schedule.seed
    breaches = (Breach(1.0, "stuck", "not flown"),) if seed == BAD else ()
    return Finding(schedule, breaches, "", 1.0 / seed, 2.0 + seed, 1, 2, 0.1 * (seed % 3))


@pytest.fixture
def fuzz(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Fuzz:
    """Search, and read what was printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cloudrc.faults.fuzz.fly", _fly)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)

    def run(seeds: int, *flags: str, code: int) -> tuple[dict[str, Any], str]:
        assert main(["faults", "fuzz", f"--seeds={seeds}", "-o", "json", *flags]) == code
        out, err = capsys.readouterr()
        return json.loads(out), err

    return run


def test_a_search_is_summed_up(fuzz: Fuzz) -> None:
    told, _ = fuzz(11, "--first", "2", code=1)
    assert (told["kind"], told["first"], told["count"]) == ("random", 2, 11)
    assert told["invariants"]["stuck"] == {"judged": 11, "broken": 1, "bound": None}
    assert told["invariants"]["fence"] == {"judged": 11, "broken": 0, "bound": 3 / 11}
    assert (told["smallest_margin_m"], told["largest_speed_mps"]) == (1 / 12, 14.0)
    assert (told["holds"], told["missions_done"], told["fallen"]) == (11, 22, 7)
    assert [failure["seed"] for failure in told["failures"]] == [BAD]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("at", [3, BAD])
def test_what_was_flown_until_it_is_told_to_stop_is_told(
    number: signal.Signals,
    at: int,
    fuzz: Fuzz,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def stopped(schedule: Schedule, keep: bool = False) -> Finding:
        if schedule.seed == at and signal.getsignal(number) not in (
            signal.SIG_DFL,
            signal.default_int_handler,
            signal.SIG_IGN,
        ):
            os.kill(os.getpid(), number)
        return _fly(schedule)

    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # nohup may have started the tests
    before = signal.getsignal(number)
    monkeypatch.setattr("cloudrc.faults.fuzz.fly", stopped)
    page = Path("page.md")
    page.write_text("of a longer one")
    told, error = fuzz(20, "--document", str(page), code=130)
    assert signal.getsignal(number) is before
    assert (told["first"], told["count"]) == (1, at)
    assert len(told["failures"]) == (at == BAD), "not shrunk, but told"
    assert page.read_text() == "of a longer one"
    rest = f"cloudrc faults fuzz --first {at + 1} --seeds {20 - at}"
    assert f"stopped; {at} of 20 were flown; continue with '{rest}'" in error


def test_two_hangups_stop_gently_a_second_signal_at_once() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    with faults_fuzz.stop_on_signal() as stop:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGHUP)
        assert stop()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # by nohup
    with faults_fuzz.stop_on_signal() as stop:
        os.kill(os.getpid(), signal.SIGHUP)
        assert not stop()


def test_who_closes_the_terminal_gets_what_goes_to_a_file(
    fuzz: Fuzz, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stopped(schedule: Schedule, keep: bool = False) -> Finding:
        os.kill(os.getpid(), signal.SIGTERM)
        return _fly(schedule)

    monkeypatch.setattr("cloudrc.faults.fuzz.fly", stopped)
    with open("/dev/full", "w") as closed:  # as such a terminal it refuses what is written
        monkeypatch.setattr(sys, "stderr", closed)
        assert main(["faults", "fuzz", "--seeds", "20", "-o", "json"]) == 130
    assert json.loads(capsys.readouterr().out)["count"] == 1


def test_workers_fly_however_this_python_starts_processes(
    fuzz: Fuzz, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From Python 3.14 on a server forks them, whose children they are."""
    default = multiprocessing.get_context("forkserver")
    monkeypatch.setattr(multiprocessing.context._default_context, "_actual_context", default)
    assert fuzz(4, "--jobs", "2", code=0)[0]["count"] == 4


def test_several_processes_stop_together(fuzz: Fuzz, monkeypatch: pytest.MonkeyPatch) -> None:
    first = os.getpid()

    def stopped(schedule: Schedule, keep: bool = False) -> Finding:
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        if schedule.seed == 3:
            os.kill(first, signal.SIGTERM)
        time.sleep(0.05)
        return _fly(schedule)

    monkeypatch.setattr("cloudrc.faults.fuzz.fly", stopped)
    told, error = fuzz(200, "--jobs", "2", "--clean", code=130)
    assert 1 <= told["count"] < 20
    rest = f"--clean --first {told['count'] + 1} --seeds {200 - told['count']}"
    assert f"continue with 'cloudrc faults fuzz {rest}'" in error
