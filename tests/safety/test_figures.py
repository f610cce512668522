"""The table of the numbers of safety: the worst of all cases, and what was missed."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from tools import figures


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figures, "FOLDER", tmp_path / "figures")


def test_of_all_cases_the_worst_is_shown(capsys: pytest.CaptureFixture[str]) -> None:
    for n, measured in enumerate((0.251, 0.252, 0.1)):
        figures.note(f"test_a.py::test_hold[{n}]", "HOLD after", measured, "<=", 0.252, "s", 1)
    figures.note("test_b.py::test_room", "clearance", 0.2, ">=", 0.12, "m", 10)
    figures.note("test_b.py::test_more", "clearance", 0.13, ">=", 0.12, "m", 20)
    assert figures.main() == 0
    head, *rows = capsys.readouterr().out.splitlines()
    assert head.split() == ["number", "asked", "measured", "N", "test"]
    assert [row.split() for row in rows] == [
        ["HOLD", "after", "<=", "0.252", "s", "0.252", "s", "3", "test_a.py"],
        ["clearance", ">=", "0.12", "m", "0.13", "m", "30", "test_b.py"],
    ]


def test_a_page_of_the_documentation_says_the_same(tmp_path: Path) -> None:
    figures.note("test_a.py::test_hold", "HOLD after", 0.251, "<=", 0.252, "s", 200)
    figures.note("test_b.py::test_flips", "accepted", 0, "==", 0, "", 1000)
    assert figures.main(["--document", str(tmp_path / "numbers.md")]) == 0
    text = (tmp_path / "numbers.md").read_text(encoding="utf-8")
    assert "| HOLD after | <= 0.252 s | 0.251 s | 200 | test_a.py |" in text.splitlines()
    assert "| accepted | == 0 | 0 | 1,000 | test_b.py |" in text.splitlines()


def test_a_test_that_is_run_again_replaces_what_it_noted() -> None:
    for measured in (5.0, 1.0):
        figures.note("test_a.py::test_a", "accepted", measured, "==", 0.0, "", 7)
    (row,) = figures.read()
    assert (row["measured"], row["count"]) == (1.0, 7)


def test_a_number_that_was_missed_fails_its_test(figure: Callable[..., None]) -> None:
    figure("accepted", 0, "==", 0)
    with pytest.raises(AssertionError, match=r"HOLD after: 0.253 s, asked <= 0.252 s"):
        figure("HOLD after", 0.253, "<=", 0.252, "s")
    with pytest.raises(AssertionError, match=r"resumed after: nan s"):
        figure("resumed after", None, "<=", 1.0, "s")
    assert [row["name"] for row in figures.read()] == ["HOLD after", "accepted", "resumed after"]


def test_what_other_sources_have_measured_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    figures.note("test_a.py::test_a", "accepted", 1.0, "==", 0.0, "", 7)
    figures.note("test_a.py::test_b", "accepted", 0.0, "==", 0.0, "", 5)
    monkeypatch.setattr(figures, "flown", lambda: "other sources")
    assert figures.read() == []
    figures.note("test_a.py::test_a", "accepted", 0.0, "==", 0.0, "", 7)
    (row,) = figures.read()
    assert (row["measured"], row["count"]) == (0.0, 7)


@pytest.mark.parametrize(
    ("measured", "relation", "asked"),
    [(0.253, "<=", 0.252), (0.1, ">=", 0.12), (1, "==", 0), (float("nan"), "<=", 1.0)],
)
def test_a_number_that_was_missed_says_so(
    measured: float, relation: str, asked: float, capsys: pytest.CaptureFixture[str]
) -> None:
    figures.note("test_a.py::test_a", "number", measured, relation, asked, "", 1)
    assert figures.main() == 1
    assert "MISSED" in capsys.readouterr().out


def test_without_numbers_it_says_how_to_get_some(capsys: pytest.CaptureFixture[str]) -> None:
    assert figures.main() == 3
    assert "make test" in capsys.readouterr().err
