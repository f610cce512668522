# SPDX-License-Identifier: Apache-2.0

"""Check a robot: its facts, a flight, what must change, and its picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cloudrc.base.files import write_atomically
from cloudrc.base.outside.paths import check_picture
from cloudrc.base.requirements import missing
from cloudrc.config import shipped
from cloudrc.config.world import ResolvedWorld
from cloudrc.results.report.shapes import read_shapes
from cloudrc.robots.check import SCENE, check, facts_table

PICTURE = "check.png"
"""Name of the picture in the folder of a robot."""


def check_robot(given: str, picture: Path | None = None) -> tuple[dict[str, Any], str]:
    """Check a robot, and draw it.

    Args:
        given: Name of a shipped robot, or path of a folder or an .xml file.
        picture: File for the picture; by default `PICTURE` in a folder of the user's own.

    Returns:
        The result as values for JSON; and a note about the picture, "" without one.
    """
    is_own = Path(given).is_dir() and (given not in shipped.names("robot") or "/" in given)
    name = shipped.model_path("robot", f"{Path(given).resolve()}" if is_own else given, Path.cwd())
    place = picture or (Path(name) / PICTURE if is_own else None)
    if place is not None:
        check_picture(place, "--picture")
    facts, changes = check(name)
    document = {"robot": given, "ok": not changes, "changes": changes, "facts": facts}
    if place is None:
        return document, ""
    if picture is None and missing("report"):
        return document, "no picture: cloudrc[report] is not installed"
    from cloudrc.results.report.robot_picture import draw_robot

    shapes = read_shapes(ResolvedWorld.model_validate({"robot": name, "scene": SCENE}))
    write_atomically(place, draw_robot(shapes.robot, place.suffix[1:]))
    return document, f"picture: {place}"


def as_text(document: Mapping[str, Any], note: str) -> str:
    """Format the result of `check_robot` for people."""
    lines = [f"must change: {each}" for each in document["changes"]] or ["nothing must change"]
    return "\n".join([facts_table(document["facts"]), "", *lines, *([note] if note else [])])
