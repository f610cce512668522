# SPDX-License-Identifier: Apache-2.0

"""Count the words of the pages, and the minutes of reading of each door: `make site` prints them.

A word is what stands between blanks, also in tables and in code. The tables that `make docs` writes
are told apart.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from statistics import median

ROOT = Path(__file__).resolve().parents[1]
SPEED = 150
"""Words that a reader reads in a minute."""
MADE = re.compile(r"<!-- made by .*?(<!-- end -->|\Z)", re.DOTALL)
FIRST = ("README.md", "## Cite")
DOORS: dict[str, tuple[tuple[str, str], ...]] = {
    "Study control": (
        FIRST,
        ("docs/tutorials/fly-and-steer.md", "## 4. "),
        ("docs/plugins-predictor.md", "## Predictor"),
    ),
    "A policy over a network": (FIRST, ("docs/tutorials/policy.md", "")),
    "Two programs or ROS nodes": (FIRST, ("docs/tutorials/two-programs.md", "")),
    "A lab on a cluster": (FIRST, ("docs/tutorials/cluster.md", "")),
    "A class": (
        FIRST,
        ("docs/exercise.md", "## Part 2"),
        ("docs/class.md", "## How it scores"),
    ),
}
"""Door -> what its reader reads until a first result of his own: a page, and the beginning of the
line before which he stops (nothing: he reads it to its end)."""


def pages() -> list[Path]:
    """Return all pages of the site, also those outside of docs/."""
    return sorted({*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("charts/**/*.md")})


def written() -> dict[str, int]:
    """Return the words of each page that somebody has written by hand."""
    texts = {page: MADE.sub("", page.read_text("utf-8")) for page in pages()}
    return {page.relative_to(ROOT).as_posix(): words(text) for page, text in texts.items() if text}


def words(text: str) -> int:
    """Count the words of a text."""
    return len(text.split())


def made() -> int:
    """Count the words that `make docs` has written."""
    texts = [page.read_text("utf-8") for page in pages()]
    return sum(words(found[0]) for text in texts for found in MADE.finditer(text))


def read_until(page: str, stop: str) -> int:
    """Count the words of a page before the line that begins with `stop`.

    Raises:
        ValueError: if the page has no such line.
    """
    text = (ROOT / page).read_text("utf-8")
    before, found, _ = text.partition(f"\n{stop}") if stop else (text, stop, "")
    if stop and not found:
        raise ValueError(f"{page}: no line that begins with '{stop}'")
    return words(before)


def lines() -> Iterator[str]:
    """Yield the report."""
    counts = written()
    total, middle = sum(counts.values()), median(counts.values())
    yield f"{len(counts)} pages by hand: {total:,} words, median {middle:.0f}"
    yield f"tables and pages by `make docs`: {made():,} words"
    longest = sorted(counts, key=lambda page: -counts[page])[:5]
    yield "longest: " + ", ".join(f"{page} {counts[page]:,}" for page in longest)
    for door, path in DOORS.items():
        count = sum(read_until(*part) for part in path)
        yield f"{door}: {count:,} words, {count / SPEED:.0f} minutes to the first own result"


if __name__ == "__main__":
    print("\n".join(lines()))
