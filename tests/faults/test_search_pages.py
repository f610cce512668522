"""The pages of the search: as many flights as were asked for, nothing broken, all of one search."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from cloudrc.cli.faults_page import INVARIANTS

SAFETY = Path(__file__).resolve().parents[2] / "docs" / "safety"
ASKED = {"search.md": 30_000, "adversary.md": 1_000, "clean.md": 600}
"""Schedules of a minute each: the long search, hostile clouds, ten hours without a fault."""
ROW = re.compile(r"^\| ([^|]+?) \| ([\d-]+) \| (\d+) \| [^|]+ \|$", re.MULTILINE)


def text_of(name: str) -> str:
    return (SAFETY / name).read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ASKED)
def test_every_invariant_was_looked_at_and_none_is_broken(name: str) -> None:
    rows = ROW.findall(text_of(name))
    assert [words for words, _, _ in rows] == [*INVARIANTS.values()]
    assert [row for row in rows if row[1] not in ("0", "-")] == []
    assert max(int(flights) for _, _, flights in rows) >= ASKED[name]


def test_they_are_of_the_same_sources() -> None:
    """Whether those are today's, `cloudrc faults fuzz --slice` tells: a slice names its own."""
    named = {re.findall(r"of its sources: `(\w+)`", text_of(name))[0] for name in ASKED}
    assert len(named) == 1
