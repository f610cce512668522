# SPDX-License-Identifier: Apache-2.0

"""Make the page of entries: one file without a request to anywhere, a table and a figure a task."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

from cloudrc.base.files import write_atomically
from cloudrc.base.statistics import exact_interval
from cloudrc.studies.rank.entry import read_entry
from cloudrc.studies.rank.score import in_order
from cloudrc.studies.rank.tasks import CONSTANT, LINKS, NONE, TASKS, VERSION

COLOURS = ("#0b5394", "#a64d00", "#38761d", "#741b47", "#444444", "#7f6000")
"""Colours of lines, each with a contrast of at least 4.5 to white."""
HEAD = (
    *("place", "policy, executor", "score", "area", NONE, *LINKS),
    *("an answer took", "played", "cloudrc", "the same again"),
)
WIDTH, HEIGHT, LEFT, TOP = 640, 190, 46, 12  # of the inner part of a figure [px]
Entry = tuple[Path, Mapping[str, Any]]
"""The file of an entry, and what it has."""
TEMPLATE = Template((Path(__file__).parent / "page.html").read_text(encoding="utf-8"))


def write_page(path: Path, files: Sequence[Path]) -> None:
    """Check the entries in some files, and write the page that ranks them."""
    content = make_page(path, files)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, content.encode())


def make_page(path: Path, files: Sequence[Path]) -> str:
    """Return the page at `path` that ranks the entries in some files.

    Raise a BadInputError that names the first file that is no entry of this version.
    """
    entries = dict[str, Entry]()
    for file in files:
        entry = read_entry(file)
        entries.setdefault(entry["sha256"], (file, entry))  # a copy is no second entry
    parts = list[str]()
    for task in TASKS:
        if mine := [each for each in entries.values() if each[1]["task"] == task]:
            parts.append(section(task, mine, path))
    return TEMPLATE.substitute(version=VERSION, tasks="".join(parts))


def section(task: str, entries: Sequence[Entry], page: Path) -> str:
    """Return the part of a page about a task with its entries."""
    files = {entry["sha256"]: file for file, entry in entries}
    ranked = in_order(entry for _, entry in entries)
    head = "".join(f'<th><button type="button">{each}</button></th>' for each in HEAD)
    lines, failed = list[str](), list[str]()
    for n, (place, entry) in enumerate(ranked):
        link = Path(os.path.relpath(files[entry["sha256"]], page.parent)).as_posix()
        cells = "".join(f"<td>{each}</td>" for each in cells_of(entry))
        words = escape(f"{Path(entry['policy']).name}, {entry['executor']}")
        name = f'<a href="{escape(link)}">{words}</a>'
        mark = f'<svg width="14" height="10"><path d="M0 5h14" {_stroke(n)}/></svg>'
        lines.append(f"<tr><td>{place or '-'}</td><td>{mark} {name}</td>{cells}</tr>")
        if entry["failed"]:
            failed.append(f"<p>{words}, failed: {escape(entry['failed'])}</p>")
    figure = draw([entry["results"] for _, entry in ranked], task)
    return (
        f'<section id="{task}"><h2>{task}</h2><p>{escape(TASKS[task].about)}</p>'
        f'<div class="wide"><table><thead><tr>{head}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>{''.join(failed)}{figure}</section>\n"
    )


def cells_of(entry: Mapping[str, Any]) -> Iterator[str]:
    """Yield the cells of an entry behind its name, as HTML."""
    yield entry["score"]
    yield f"{entry['area']:.3f}"
    done = {each["link"]: each["success"] for each in entry["results"] if each["rtt_ms"] is None}
    yield from (rate(done[each]) if each in done else "-" for each in (NONE, *LINKS))
    yield from (escape(entry["answer"]), escape(entry["date"]))
    yield escape(f"{entry['versions']['cloudrc']} ({entry['code'][:7]})")
    yield f"<code>{escape(entry['command'])}</code>"


def rate(digits: str) -> str:
    """Return how many seeds succeed; on demand with the 95 % interval."""
    done, count = digits.count("1"), len(digits)
    low, high = exact_interval(done, count)
    return f'<span title="95 %: {low:.0%} to {high:.0%}">{done}/{count}</span>'


def _stroke(n: int) -> str:
    dash = ("", ' stroke-dasharray="5 3"')[n // len(COLOURS) % 2]
    return f'fill="none" stroke="{COLOURS[n % len(COLOURS)]}" stroke-width="2"{dash}'


def draw(every: Sequence[Sequence[Mapping[str, Any]]], task: str) -> str:
    """Draw the success of each entry over the round trip, with its 95 % intervals, as SVG.

    The round trips of the grid are equally far apart.
    """
    parts = list[str]()
    for share in (0.0, 0.5, 1.0):  # below the lines of the entries
        y = _height(share)
        parts.append(f'<path d="M{LEFT} {y}h{WIDTH}" stroke="#ccc"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{y + 4}" text-anchor="end">{share:.0%}</text>')
    for n, results in enumerate(every):
        grid = [each for each in results if each["link"] == CONSTANT]
        points = list[str]()
        for k, each in enumerate(grid):
            done, count = each["success"].count("1"), len(each["success"])
            x = LEFT + (k + 0.5 + (n - (len(every) - 1) / 2) * 0.06) * WIDTH / len(grid)
            low, high = (_height(bound) for bound in exact_interval(done, count))
            points.append(f"{x:.1f},{_height(done / count):.1f}")
            parts.append(f'<path d="M{x:.1f} {low:.1f}V{high:.1f}" {_stroke(n)}/>')
        parts.append(f'<polyline points="{" ".join(points)}" {_stroke(n)}/>')
    grid = next(([e for e in each if e["link"] == CONSTANT] for each in every if each), [])
    for k, each in enumerate(grid):
        x = LEFT + (k + 0.5) * WIDTH / len(grid)
        parts.append(
            f'<text x="{x:.0f}" y="{TOP + HEIGHT + 16}" text-anchor="middle">'
            f"{each['rtt_ms']:g}</text>"
        )
    return (
        f'<svg class="figure" viewBox="0 0 {LEFT + WIDTH + 8} {TOP + HEIGHT + 36}" role="img" '
        f'aria-label="success in {task} over the round trip">{"".join(parts)}'
        f'<text x="{LEFT + WIDTH / 2:.0f}" y="{TOP + HEIGHT + 32}" text-anchor="middle">'
        "episodes won over the round trip [ms], constant</text></svg>"
    )


def _height(share: float) -> float:
    return TOP + (1.0 - share) * HEIGHT
