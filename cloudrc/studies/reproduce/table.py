# SPDX-License-Identifier: Apache-2.0

"""Make the table of the paper's statements, as values for JSON, as text and in Markdown."""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cloudrc.base.text import table
from cloudrc.flight.trials.rows import Row
from cloudrc.studies.reproduce.flights import HALVED, ORDERS
from cloudrc.studies.reproduce.statements import (
    MISSING,
    QUANTITIES,
    STATEMENTS,
    Cells,
    TableRow,
    group,
)

WIDTH = 100
"""Width of the text [letters]."""
FILE = "reproduce.png"
"""File of the figure, beside the page."""
YES = {True: "yes", False: "no"}
FLOWN = "seed", "verdict", "failures", "text", "measured", "records_sha256"
"""What the document has of each flight, besides its condition; the file of rows has all metrics."""
CAPTION = (
    "arrival: the robot follows the command that arrives last, as published (`paper-verbatim`); "
    "newest: the newest command (`paper`). Delays: mean ± half of their range. P1-P2-P3: all three "
    f"in one mission, from 0, 10 and 20 s on; {HALVED}: the same with half of all delays. Medians "
    "over the flights of a cell; x to y: the range over them. The numbers beside a statement are "
    "of arrival, if they name neither newest nor both orders."
)


FIGURE = (
    "One mission as published, seed 1; P2 and P3 begin at the dotted lines. (a) Loop delay: from a "
    "command to its first echo, the paper's tau_n; estimate: eq. (1); grey and green: limits and "
    "mean of the links, both ways. (b) to (d) Position in x, y and z. (e) Distance from the "
    "reference to the measured and to the estimated position."
)


def describe(rows: Sequence[Row]) -> dict[str, Any]:
    """Return the document of all flights, as values for JSON."""
    cells = group(rows)
    return {
        "seeds": max(row["seed"] for row in rows),
        "statements": [
            {
                "number": each.number,
                "claim": each.claim,
                "reproduced": each.holds(cells),
                "found": each.found(cells),
                "differs": each.differs,
            }
            for each in STATEMENTS
        ],
        "quantities": [line for each in QUANTITIES for line in _lines(each, cells)],
        "not_reproduced": MISSING,
        "flights": [
            {**row["point"], **{name: row[name] for name in FLOWN if name in row}} for row in rows
        ],
    }


def _lines(quantity: TableRow, cells: Cells) -> Iterator[dict[str, Any]]:
    """Yield the row of a quantity for each order, or one row if both are equal."""
    columns = dict.fromkeys(column for _, column, _ in cells)
    found = {
        order: {
            column: quantity.cell(rows) if rows else "-"
            for column in columns
            for rows in [cells.get((order, column, quantity.hover), ())]
        }
        for order in ORDERS
    }
    arrival, newest = found.values()
    if arrival == newest:
        found = {"both": arrival}
    for order, each in found.items():
        if {*each.values()} != {"-"}:
            about = {"statement": quantity.statement, "quantity": quantity.label}
            yield {**about, "order": order, **each}


def _quantities(document: Mapping[str, Any]) -> list[list[str]]:
    head, before = ["", *[*document["quantities"][0]][1:]], (0, "")
    rows = list[list[str]]()
    for each in document["quantities"]:
        number, label, *cells = each.values()
        first = "" if before[0] == number else str(number)
        rows.append([first, "" if before == (number, label) else label, *cells])
        before = number, label
    return [head, *rows]


def as_text(document: Mapping[str, Any]) -> str:
    """Format the table, what is found for each statement, and what is not reproduced."""
    blocks = [table(_quantities(document)), _filled(CAPTION)]
    for each in document["statements"]:
        head = f"{each['number']}  {each['claim']}: {YES[each['reproduced']]}; {each['found']}"
        blocks.append(f"{_filled(head)}\n{_filled(each['differs'], '   ')}")
    others = (f"{what}: {instead}" for what, instead in document["not_reproduced"].items())
    blocks.append("\n".join(["Not reproduced, and what stands in its place:", *others]))
    return "\n\n".join(blocks)


def _filled(text: str, indent: str = "") -> str:
    return textwrap.fill(text, WIDTH, initial_indent=indent, subsequent_indent="   ")


def as_markdown(document: Mapping[str, Any]) -> str:
    """Format all of `as_text` in Markdown, with the figure in the file `FILE`."""
    others = document["not_reproduced"].items()
    parts = [
        summary(document),
        f"![Delay, position and error of one mission over the paper's three links]({FILE})",
        FIGURE,
        _markdown(_quantities(document)),
        CAPTION,
        *(f"**{each['number']}.** {each['differs']}" for each in document["statements"]),
        _markdown([["not reproduced", "in its place"], *map(list, others)]),
    ]
    return "\n\n".join(parts) + "\n"


def summary(document: Mapping[str, Any], numbers: Sequence[int] = range(1, 9)) -> str:
    """Format the statements with these numbers as a table in Markdown."""
    chosen = [each for each in document["statements"] if each["number"] in numbers]
    rows = ([str(s["number"]), s["claim"], YES[s["reproduced"]], s["found"]] for s in chosen)
    return _markdown([["", "the paper", "reproduced", "here"], *rows])


def _markdown(rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in rows]
    return "\n".join([lines[0], "|" + "---|" * len(rows[0]), *lines[1:]])
