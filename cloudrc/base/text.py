# SPDX-License-Identifier: Apache-2.0

"""Texts: tables for people, programs and papers; numbers, positions; text from files."""

from __future__ import annotations

import difflib
import io
import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

FAILED_MARK = "*"
"""Mark of a number in a table if some of its flights failed."""
FAILED_NOTE = (
    f"{FAILED_MARK} contains flights that failed: a robot that hardly moves has small errors, too"
)
"""Note below a table with such a mark."""
LISTED = 30
"""Most known names that an error about an unknown name lists, if it can name similar ones."""
Paint: TypeAlias = Callable[[str, str], str]
"""Function that returns a text in a colour of the terminal, such as "red"."""


def plain(text: str, colour: str) -> str:
    """Return a text without a colour."""
    return text


def escape(text: str) -> str:
    """Escape unprintable characters, which could break the line or control the terminal."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def describe_point(position: Sequence[float | None]) -> str:
    """Format a position [m]; an unknown coordinate, None, becomes a question mark."""
    return f"({', '.join('?' if value is None else f'{value:.2f}' for value in position)})"


def describe_sensors(sensors: Sequence[Mapping[str, Any]]) -> str:
    """Format what a robot's own sensors show, as the API tells it; "" without sensors."""
    shown = (
        f"{each['name']} {'?' if each['value'] is None else format(each['value'], '.3g')} "
        f"{each['unit']}"
        for each in sensors
    )
    return ", ".join(shown)


def format_number(value: float) -> str:
    """Format a value of any unit with four significant digits, and a count with all digits."""
    if float(value).is_integer() and abs(value) < 1e5:
        return f"{value:.0f}"  # counts
    if 1e-4 <= abs(value) < 1e5:
        digits = f"{value:#.4g}"
        return digits.rstrip(".") if abs(value) >= 1000 else digits
    return f"{value:.3e}"


def table(rows: Sequence[Sequence[str]], right: Sequence[int] = ()) -> str:
    """Align rows of equal length in columns; return one line per row.

    Unprintable characters are escaped. Columns with an index in `right` are aligned to the right.
    """
    columns = []
    for index, column in enumerate(zip(*rows, strict=True)):
        shown = [escape(cell).rstrip() if index in right else escape(cell) for cell in column]
        width = max(map(_width, shown))
        blanks = [" " * (width - _width(cell)) for cell in shown]
        pairs = (
            zip(blanks, shown, strict=True) if index in right else zip(shown, blanks, strict=True)
        )
        columns.append([first + second for first, second in pairs])
    return "\n".join("  ".join(line).rstrip() for line in zip(*columns, strict=True))


def _width(cell: str) -> int:
    """Return how many columns of a terminal a text takes."""
    if cell.isascii():
        return len(cell)
    from rich.cells import cell_len

    return cell_len(cell)


def list_some(texts: Sequence[str], most: int = 3) -> str:
    """List the first `most` texts, and count the others."""
    more = len(texts) - most
    return ", ".join(texts[:most]) + f" and {more} more" * (more > 0)


def cells(rows: Sequence[Mapping[str, Any]], columns: Mapping[str, str]) -> list[tuple[str, ...]]:
    """Return a table as text: `columns` are head -> form of a cell, such as "{age_ms:.0f} ms".

    A cell whose value a row lacks is "-"; a column with such cells alone is left out.
    """

    def cell(form: str, row: Mapping[str, Any]) -> str:
        try:
            return form.format_map(row)
        except (KeyError, TypeError):  # None has no digits
            return "-"

    found = [(head, *(cell(form, row) for row in rows)) for head, form in columns.items()]
    return list(zip(*(each for each in found if {*each[1:]} - {"-"}), strict=True))


def latex_table(rows: Sequence[Sequence[str]]) -> str:
    """Return rows, the first of them the head, as a table of LaTeX; it needs booktabs."""
    head, *lines = [" & ".join(map(_latex, row)) + r" \\" for row in rows]
    begin = r"\begin{tabular}{l" + "r" * (len(rows[0]) - 1) + "}  % \\usepackage{booktabs}"
    parts = (begin, r"\toprule", head, r"\midrule", *lines, r"\bottomrule", r"\end{tabular}")
    return "\n".join(parts)


def _latex(cell: str) -> str:
    """Escape a cell; a hyphen before a number becomes a minus."""
    text = re.sub(r"[&%$#_{}]", r"\\\g<0>", cell.replace(" .. ", " to "))
    return re.sub(r"(?<!\w)-(?=\d)", "$-$", text)


def csv_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return rows of plain values as CSV; a value that a row lacks, or that is None, is empty."""
    import csv

    names = dict.fromkeys(name for row in rows for name in row)
    text = io.StringIO()
    writer = csv.DictWriter(text, list(names), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue().rstrip("\n")


def unknown_name_text(what: str, name: str, available: list[str]) -> str:
    """Return an error text for an unknown name: the known names, and the most similar name.

    Of more than `LISTED` known names, it has the similar ones, if there are any.
    """
    near = difflib.get_close_matches(name, available, n=5) if len(available) > LISTED else []
    label, known = "similar" if near else "available", ", ".join(near or available) or "none"
    return f"no {what} named {name!r}; {label}: {known}{suggest_name(name, available)}"


def suggest_name(name: str, available: list[str]) -> str:
    """Return a suggestion of the most similar name, to append to an error text; or "" if none."""
    near = difflib.get_close_matches(name, available, n=1)
    return f"; did you mean {near[0]}?" if near else ""
