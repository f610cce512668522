# SPDX-License-Identifier: Apache-2.0

"""Draw the wings of the package, and list them: `make docs` writes both for docs/architecture.md.

The order comes from the contract `layers` in pyproject.toml, the words from the docstrings.
"""

from __future__ import annotations

import ast
import tomllib
from pathlib import Path

from tools.markdown import table

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "wings.svg"
LOOSE = ("__main__", "version")
"""Modules at both ends of the order, which are no wings."""
FLIGHT = "flight"
"""The highest wing of the core; those above it are guests."""
WIDTH, LEFT, GAP, HEIGHT, STEP = 960, 130, 8, 46, 54
"""Of the picture, of its column on the left, between boxes, of a box, from line to line."""
COLOURS = {
    "world": ("#ddf4ff", "#0969da"),
    "link": ("#fff8c5", "#bf8700"),
    "cloud": ("#dafbe1", "#1a7f37"),
}
"""Wing -> fill and edge, as in docs/loop.svg."""
PLAIN = "#f6f8fa", "#8c959f"
HEAD = """\
<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" \
aria-labelledby="title" font-family="-apple-system, 'Segoe UI', Helvetica, Arial, sans-serif" \
font-size="15" text-anchor="middle">
  <title id="title">The wings of cloudrc, from doors to base: each imports only wings below it.\
</title>
  <style>
    .note {{ font-size: 12.5px; fill: #57606a }}
    text {{ fill: #1f2328 }}
  </style>
  <rect width="{width}" height="{height}" rx="12" fill="#ffffff"/>
"""


def layers() -> list[list[str]]:
    """Return the wings of each line, from the highest line to the lowest."""
    tool = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["tool"]["importlinter"]
    (rule,) = (each for each in tool["contracts"] if each["id"] == "layers")
    lines = (line.split(" | ") for line in rule["layers"])
    return [line for line in lines if line[0] not in LOOSE]


def guests() -> set[str]:
    """Return the wings above the core, which does not know them."""
    lines = layers()
    return {wing for line in lines[: lines.index([FLIGHT])] for wing in line}


def about(wing: str) -> str:
    """Return the first line of the docstring of a wing."""
    folder = ROOT / "cloudrc" / wing
    file = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    told = ast.get_docstring(ast.parse(file.read_text("utf-8"))) or ""
    return told.partition("\n")[0].rstrip(".")


def listed() -> str:
    """Return the table of the wings."""
    rows = []
    for line in layers():
        for wing in line:
            name = f"{wing}/" if (ROOT / "cloudrc" / wing).is_dir() else f"{wing}.py"
            rows.append((f"`{name}`", about(wing)))
    return table("wing | what it is", rows)


def picture() -> str:
    """Draw a box for each wing, a line for each layer."""
    lines = layers()
    height = GAP + STEP * len(lines)
    core = lines.index([FLIGHT])
    drawn = [HEAD.format(width=WIDTH, height=height)]
    for name, note, first, last in (
        ("guests", "use the core", 0, core),
        ("core", "knows no guest", core, len(lines)),
    ):
        drawn.append(_side(name, note, GAP + STEP * first, STEP * (last - first) - GAP))
    for number, line in enumerate(lines):
        width = (WIDTH - LEFT - GAP * (len(line) + 1)) / len(line)
        for place, wing in enumerate(line):
            x = LEFT + GAP + place * (width + GAP)
            drawn.append(_box(wing, x, GAP + STEP * number, width))
    return "".join([*drawn, "</svg>\n"])


def _side(name: str, note: str, y: float, height: float) -> str:
    middle, x = y + height / 2, LEFT / 2 + GAP / 2
    return (
        f'  <rect x="{GAP}" y="{y:g}" width="{LEFT - GAP}" height="{height:g}" rx="8" '
        f'fill="none" stroke="{PLAIN[1]}" stroke-dasharray="4 3"/>\n'
        f'  <text x="{x:g}" y="{middle - 3:g}" font-weight="600">{name}</text>\n'
        f'  <text class="note" x="{x:g}" y="{middle + 14:g}">{note}</text>\n'
    )


def _box(wing: str, x: float, y: float, width: float) -> str:
    fill, edge = COLOURS.get(wing, PLAIN)
    note = about(wing).partition(":")[0]
    return (
        f'  <rect x="{x:g}" y="{y:g}" width="{width:g}" height="{HEIGHT}" rx="8" '
        f'fill="{fill}" stroke="{edge}" stroke-width="1.5"/>\n'
        f'  <text x="{x + width / 2:g}" y="{y + 19:g}" font-weight="600">{wing}</text>\n'
        f'  <text class="note" x="{x + width / 2:g}" y="{y + 36:g}">{note}</text>\n'
    )
