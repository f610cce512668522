# SPDX-License-Identifier: Apache-2.0

"""Draw docs/meta-world.png: what `cloudrc eval` has measured with the arm of Meta-World.

Meta-World needs an old MuJoCo, so the numbers are here. Each condition has 20 episodes, of
Meta-World 3.1.1 over the link lte.
"""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.statistics import exact_interval
from cloudrc.results.report.figures.bands import Panel, Point, draw
from cloudrc.results.report.figures.style import Look

EPISODES = 20
RTT_MS = 0, 50, 100, 150, 300, 600
"""Mean round trip of each condition [ms]."""
SUCCESSES = {
    "reach-v3": (20, 20, 20, 20, 20, 9),
    "push-v3": (20, 19, 18, 0, 0, 1),
    "pick-place-v3": (20, 14, 6, 4, 1, 0),
    "door-open-v3": (20, 20, 10, 1, 2, 6),
}
"""Task -> number of successes of each condition; without a network all episodes succeed."""


def draw_arm(target: Path) -> None:
    """Draw the share of successes over the round trip, a line per task."""
    lines = {}
    for task, counts in SUCCESSES.items():
        lines[task] = list[Point]()
        for rtt_ms, count in zip(RTT_MS, counts, strict=True):
            low, high = exact_interval(count, EPISODES)
            share = 100 * count / EPISODES
            lines[task].append(Point(rtt_ms, share, 100 * low, 100 * high, failed=False))
    panel = Panel("success of 20 episodes", "%", lines, baseline=100.0)
    files = draw([panel], "round trip_ms", [], "task", look=Look(width=5.0))
    target.write_bytes(files["png"])
