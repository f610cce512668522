# SPDX-License-Identifier: Apache-2.0

"""Write the tables of ranked policies, and their page, from the entries in docs/rank."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from cloudrc.studies.rank.entry import read_entry
from cloudrc.studies.rank.page import make_page
from cloudrc.studies.rank.score import in_order
from cloudrc.studies.rank.tasks import GRID
from tools.markdown import table

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "docs" / "rank"
MARKS = re.compile(r"(<!-- ranked: (.*) -->\n).*?(<!-- end of ranking -->)", re.DOTALL)
"""Around a generated table; the first mark names its tasks."""
PAGES = ("eval.md", "ranking.md", "results.md")


def outputs() -> dict[Path, str]:
    """Generate the page of the ranking, and the tables of pages: file -> text."""
    files = sorted(FOLDER.glob("*.json"))
    made = {FOLDER / "index.html": make_page(FOLDER / "index.html", files)}
    for name in PAGES:
        page = ROOT / "docs" / name
        made[page] = MARKS.sub(
            lambda found: f"{found[1]}{rows(found[2].split(), files)}{found[3]}",
            page.read_text("utf-8"),
        )
    return made


def rows(tasks: Sequence[str], files: Sequence[Path]) -> str:
    """Return the table of the entries for some tasks."""
    entries = [read_entry(each) for each in files]
    lines = list[tuple[str, ...]]()
    for task in tasks:
        for _, entry in in_order(each for each in entries if each["task"] == task):
            done = {
                each["rtt_ms"]: each["success"].count("1")
                for each in entry["results"]
                if each["rtt_ms"] is not None
            }
            some = (str(done[rtt]) for rtt in GRID)
            name = f"`{entry['policy']}`, {entry['executor']}"
            lines.append((f"`{task}`", name, entry["score"], f"{entry['area']:.3f}", *some))
    head = " | ".join(("task", "policy, executor", "score", "area", *(f"{rtt:g}" for rtt in GRID)))
    return table(head, lines)
