"""A long search in slices: each tells what it holds, together they are one search, or refused."""

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

from cloudrc.cli import faults_fuzz, faults_slices
from cloudrc.cli.main import main
from cloudrc.faults.fuzz import Finding
from cloudrc.faults.schedule import Schedule
from cloudrc.faults.watch import Breach

Fuzz = Callable[..., dict[str, Any]]
BAD = 7
"""The seed whose flight breaks an invariant."""


def _fly(schedule: Schedule, keep: bool = False) -> Finding:
    """As good as a flight: what it shows depends on the seed."""
    seed = schedule.seed
    breaches = (Breach(1.0, "stuck", "not flown"),) if seed == BAD else ()
    return Finding(schedule, breaches, "", 1.0 / seed, 2.0 + seed, 1, 2, 0.1 * (seed % 3))


@pytest.fixture
def fuzz(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fuzz:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("cloudrc.faults.fuzz.fly", _fly)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)

    def run(name: str, first: int, seeds: int, *flags: str, code: int = 0) -> dict[str, Any]:
        line = ["faults", "fuzz", f"--first={first}", f"--seeds={seeds}", f"--slice={name}"]
        assert main([*line, *flags]) == code
        told: dict[str, Any] = json.loads(Path(name).read_text())
        return told

    return run


def test_slices_are_added_up_to_what_one_search_has_shown(
    fuzz: Fuzz, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = fuzz("whole.json", 1, 12, code=1)
    for name, first, seeds in (("a.json", 1, 3), ("b.json", 4, 6), ("c.json", 10, 3)):
        fuzz(name, first, seeds, code=int(first <= BAD < first + seeds))
    capsys.readouterr()
    line = "faults merge c.json a.json b.json --document search.md -o json"
    assert main(line.split()) == 1
    added = json.loads(capsys.readouterr().out)
    assert added.pop("seconds") > 0.0
    assert added.pop("hours") == pytest.approx(whole["hours"])
    assert added == {name: whole[name] for name in added}
    assert added["invariants"]["stuck"]["broken"] == 1
    page = Path("search.md").read_text()
    assert "Written by `cloudrc faults merge SLICE... --document search.md`" in page
    assert "- `cloudrc faults fuzz --first 4 --seeds 6 --slice b.json`\n" in page
    assert "| collisions | 0 | 12 | p < 0.25 |" in page
    assert f"`{faults_slices.sources()[:16]}`" in page


def test_a_sum_of_slices_is_a_slice(fuzz: Fuzz, capsys: pytest.CaptureFixture[str]) -> None:
    """Who has hundreds keeps one, and goes on from there."""
    for name, first in (("a.json", 1), ("b.json", 4), ("c.json", 7)):
        fuzz(name, first, 3, code=int(first == BAD))
    assert main("faults merge a.json b.json --slice sum.json".split()) == 0
    capsys.readouterr()
    assert main("faults merge sum.json c.json -o json".split()) == 1
    of_two = json.loads(capsys.readouterr().out)
    assert main("faults merge a.json b.json c.json -o json".split()) == 1
    of_three = json.loads(capsys.readouterr().out)
    assert of_two == {**of_three, "seconds": pytest.approx(of_three["seconds"])}


def test_a_page_tells_slices_of_one_length_in_a_line(fuzz: Fuzz) -> None:
    for first, seeds in ((1, 1), (2, 2), (4, 2), (6, 1)):
        fuzz(f"{first}.json", first, seeds)
    line = "faults merge 1.json 2.json 4.json 6.json --document search.md"
    assert main(line.split()) == 0
    flown = [line for line in Path("search.md").read_text().splitlines() if "--slice" in line]
    assert flown == [
        "- `cloudrc faults fuzz --seeds 1 --slice 1.json`",
        "- `cloudrc faults fuzz --first 2 --seeds 2 --slice 2.json` to "
        "`cloudrc faults fuzz --first 4 --seeds 2 --slice 4.json`: 2 of 2 each",
        "- `cloudrc faults fuzz --first 6 --seeds 1 --slice 6.json`",
    ]


def test_what_is_printed_as_json_is_a_slice(fuzz: Fuzz, capsys: pytest.CaptureFixture[str]) -> None:
    told = fuzz("a.json", 1, 3, "-o", "json")
    assert json.loads(capsys.readouterr().out) == told
    assert (told["first"], told["count"], told["kind"]) == (1, 3, "random")


def _broken(path: str, **values: Any) -> None:
    told = json.loads(Path("b.json").read_text())
    Path(path).write_text(json.dumps({**told, **values}))


@pytest.mark.parametrize(
    ("slices", "words"),
    [
        ("a.json c.json", "seeds 4 to 6 are missing between a.json and c.json; fly them: cloudrc "),
        ("a.json c.json", "faults fuzz --first 4 --seeds 3 --slice FILE"),
        ("a.json b.json d.json", "d.json: seeds 6 to 6 are in b.json, too"),
        ("b.json a.json b.json", "b.json: seeds 4 to 6 are in b.json, too"),
        ("a.json clean.json", "kind clean, but a.json has random"),
        ("a.json other.json", "other.json: sources 1234, but a.json has"),
        ("a.json gone.json", "gone.json: cannot be read as a slice"),
        ("a.json torn.json", "torn.json: cannot be read as a slice"),
        ("a.json empty.json", "empty.json: is no slice; write one by 'cloudrc faults fuzz --slice"),
        ("a.json words.json", "words.json: is no slice"),
    ],
)
def test_what_is_not_one_search_is_refused_by_name(
    slices: str, words: str, fuzz: Fuzz, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, first, seeds in (("a.json", 1, 3), ("b.json", 4, 3), ("d.json", 6, 1)):
        fuzz(name, first, seeds)
    fuzz("c.json", 7, 2, code=1)
    fuzz("clean.json", 4, 3, "--clean")
    _broken("other.json", sources="1234")
    _broken("words.json", holds="many")
    Path("torn.json").write_text(Path("a.json").read_text()[:-9])
    Path("empty.json").write_text("{}")
    capsys.readouterr()
    assert main(["faults", "merge", *slices.split(), "--document", "page.md"]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not Path("page.md").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("at", [3, BAD])
def test_what_was_flown_until_it_is_told_to_stop_is_a_slice(
    number: signal.Signals,
    at: int,
    fuzz: Fuzz,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
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
    told = fuzz("a.json", 1, 20, "--document", str(page), code=130)
    assert signal.getsignal(number) is before
    assert (told["first"], told["count"]) == (1, at)
    assert len(told["failures"]) == (at == BAD), "not shrunk, but told"
    assert page.read_text() == "of a longer one"
    rest = f"cloudrc faults fuzz --first {at + 1} --seeds {20 - at}"
    assert f"stopped; {at} of 20 are kept in a.json; go on with '{rest}'" in (
        capsys.readouterr().err
    )
    monkeypatch.setattr("cloudrc.faults.fuzz.fly", _fly)
    fuzz("b.json", at + 1, 20 - at, code=int(at < BAD))
    assert main(["faults", "merge", "a.json", "b.json"]) == 1


def test_a_terminal_that_is_closed_says_so_twice_and_a_second_wish_ends_it_at_once() -> None:
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    with faults_fuzz.stopping() as stop:
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGHUP)
        assert stop()
        with pytest.raises(KeyboardInterrupt):
            os.kill(os.getpid(), signal.SIGTERM)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # by nohup
    with faults_fuzz.stopping() as stop:
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
    assert fuzz("a.json", 1, 4, "--jobs", "2")["count"] == 4


def test_without_a_name_the_slice_lies_beside_what_was_found(
    fuzz: Fuzz, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(schedule: Schedule, keep: bool = False) -> Finding:
        os.kill(os.getpid(), signal.SIGTERM)
        return _fly(schedule)

    monkeypatch.setattr("cloudrc.faults.fuzz.fly", stopped)
    assert main(["faults", "fuzz", "--seeds", "5"]) == 130
    assert json.loads(Path("faults-found/slice-random-1-1.json").read_text())["count"] == 1


def test_what_was_flown_is_kept_every_while(fuzz: Fuzz, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever is killed without a word leaves what he has told last."""
    monkeypatch.setattr("cloudrc.cli.faults_fuzz.PROGRESS_PERIOD", -1.0)
    kept: list[int] = []
    keep = faults_slices.keep

    def see(told: dict[str, Any], path: Path) -> None:
        kept.append(told["count"])
        keep(told, path)

    monkeypatch.setattr(faults_slices, "keep", see)
    fuzz("a.json", 1, 4)
    assert kept == [1, 2, 3, 4, 4]


def test_several_processes_stop_together_and_leave_a_slice_without_a_gap(
    fuzz: Fuzz, monkeypatch: pytest.MonkeyPatch
) -> None:
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
    told = fuzz("a.json", 1, 200, "--jobs", "2", "--clean", code=130)
    assert 1 <= told["count"] < 20
    monkeypatch.setattr("cloudrc.faults.fuzz.fly", _fly)
    fuzz("b.json", told["count"] + 1, 200, "--jobs", "2", "--clean", code=int(told["count"] < BAD))
    assert main(["faults", "merge", "a.json", "b.json"]) == 1
