"""Whether netem is still as it was set up: listings of tc go in, what is wrong comes out.

Other hands reach a pod's interface, too: a person, a network plug-in, another tool. A link that is
not what was asked for and does not say so is worse than none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from cloudrc.link.netem_check import differences

ROOT, BAND, LEAF = "7400:", "7400:4", "7401:"
"""Handles of the classful root, of its band for the tunnel's flow, and of the netem there."""
PERIOD_NS = 1_000_000_000
"""Between two looks at the qdiscs [ns]."""
FILTER_LOOKS = 10
"""Every so many looks the filter is looked at, too, which takes a process of its own."""


def is_ours(qdiscs: Sequence[dict[str, Any]]) -> bool:
    """Say whether the root of an interface is what `Netem` puts there."""
    return any(
        one.get("root") and one.get("handle") == ROOT and one.get("kind") == "prio"
        for one in qdiscs
    )


def counters(qdiscs: Sequence[dict[str, Any]]) -> dict[str, int]:
    """Read what netem has counted from the objects of `tc -s -j qdisc show`.

    Returns:
        `forwarded`: sent on, copies included; `lost`: dropped, whether by chance or because the
        queue was full; `held`: queued now. Empty if there is no such qdisc.
    """
    for one in qdiscs:
        if one.get("handle") == LEAF and one.get("kind") == "netem":
            return {"forwarded": one["packets"], "lost": one["drops"], "held": one["qlen"]}
    return {}


def damage(qdiscs: Sequence[dict[str, Any]], applied: Sequence[str]) -> str:
    """Say in words what somebody has done to the qdiscs.

    Args:
        qdiscs: Of the interface.
        applied: Words that netem was given last.

    Returns:
        "" if nothing.
    """
    leaf = next((one for one in qdiscs if one.get("handle") == LEAF), None)
    if not is_ours(qdiscs) or leaf is None or leaf.get("kind") != "netem":
        return "was removed"
    found = differences(applied, leaf.get("options", {}))
    return f"was changed ({'; '.join(found)})" if found else ""


class Kept:
    """What has been put back, and what the qdiscs before had counted.

    Attributes:
        restored: How often something was put back.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self.restored = 0
        self._log, self._said = log, ""
        self._looked_ns, self._looks = -PERIOD_NS, 0
        self._now: dict[str, int] = {}
        self._before: dict[str, int] = {}

    def due(self, now_ns: int) -> bool:
        """Say whether it is time for a look [ns]."""
        return now_ns - self._looked_ns >= PERIOD_NS

    def looks(self, now_ns: int) -> bool:
        """Note that it is looked now [ns]; True if the filter's turn has come, too."""
        self._looked_ns = now_ns
        self._looks += 1
        return self._looks % FILTER_LOOKS == 0

    def counted(self, counts: dict[str, int]) -> dict[str, int]:
        """Add what qdiscs before have counted; a new one begins at 0."""
        if not counts or counts["forwarded"] < self._now.get("forwarded", 0):
            for name in ("forwarded", "lost"):
                self._before[name] = self._before.get(name, 0) + self._now.get(name, 0)
        self._now = counts
        totals = counts or dict.fromkeys(self._before, 0)
        return {name: n + self._before.get(name, 0) for name, n in totals.items()}

    def put_back(self, what: str) -> None:
        """Note that it was put back after somebody has done `what`; log it."""
        self.restored += 1
        self._said = ""
        self._log(f"{what} by another hand, and put back ({self.restored} times so far)")

    def cannot(self, what: str, why: str) -> None:
        """Note that it cannot be put back; log it unless that was the last thing that was said."""
        line = f"{what} by another hand, and cannot be put back: {why}"
        if line != self._said:
            self._said = line
            self._log(line)
