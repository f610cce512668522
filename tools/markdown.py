# SPDX-License-Identifier: Apache-2.0

"""Write parts of pages in Markdown."""

from __future__ import annotations

from collections.abc import Iterable


def table(columns: str, rows: Iterable[Iterable[object]]) -> str:
    """Format a table in Markdown; `columns` contains the column titles, separated by bars."""
    lines = [f"| {columns} |", f"|{'---|' * len(columns.split('|'))}"]
    for row in rows:
        lines.append(f"| {' | '.join(str(cell).replace('|', chr(92) + '|') for cell in row)} |")
    return "\n".join(lines) + "\n"
