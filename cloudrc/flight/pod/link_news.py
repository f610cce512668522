# SPDX-License-Identifier: Apache-2.0

"""Tell each change of the link's profile, from the state file of a link process."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from cloudrc.base.errors import to_one_line
from cloudrc.base.files import Watched
from cloudrc.base.files import read as read_file
from cloudrc.link.state import STATE_MAX, LinkState, from_text

LOOK_NS = 500_000_000
"""Time between two looks at the state file [ns]."""
VALUE_MAX = 60
"""Longest text of a value, such as a schedule, in a sentence [characters]."""


class LinkNews:
    """Follows the state file of a link process, which describes both directions."""

    def __init__(self, path: Path) -> None:
        """Follow the file at `path`, which may not exist yet."""
        self._file = Watched(path, LOOK_NS)
        self._state: LinkState | None = None

    def look(self, now_ns: int) -> str:
        """Return a sentence about a change since the last look; "" without a change."""
        if not self._file.is_new(now_ns):
            return ""
        try:
            before, self._state = self._state, from_text(read_file(self._file.path, STATE_MAX))
        except (OSError, ValueError):  # missing or malformed, which a link process repairs
            return ""
        return describe_change(before, self._state)


def describe_change(before: LinkState | None, after: LinkState) -> str:
    """Return a sentence about the change of a link; "" without a change of its profile."""
    if before is None:
        return ""
    if changed := [*_differences(before.profile, after.profile)]:
        return f"the link has changed: {', '.join(changed)} ({to_one_line(after.cause)})"
    if after.changes > before.changes:
        return f"the link's schedule has begun again ({to_one_line(after.cause)})"
    return ""


def _differences(before: dict[str, Any], after: dict[str, Any]) -> Iterator[str]:
    """Yield "uplink.delay_ms 70 (was 45)" for each different value of a direction."""
    for way in ("uplink", "downlink"):
        old, new = before.get(way) or {}, after.get(way) or {}
        for key in dict.fromkeys([*new, *old]):
            if old.get(key) != new.get(key):
                yield f"{way}.{key} {_show(new.get(key))} (was {_show(old.get(key))})"


def _show(value: Any) -> str:
    if value is None:
        return "not set"
    if isinstance(value, float):
        return f"{value:g}"
    text = to_one_line(json.dumps(value))
    return text if len(text) <= VALUE_MAX else f"{text[: VALUE_MAX - 3]}..."
