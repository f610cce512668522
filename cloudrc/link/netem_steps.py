"""How well a time line is followed: instants go in, counts and a line for people come out."""

from __future__ import annotations

from collections import deque
from math import ceil

from cloudrc.link.netem_text import STEP_NS

LATE_NS = 20_000_000
"""A step that is later than this is counted as late [ns]: two periods of the loop."""
_KEPT = 10_000


class Steps:
    """Counts the steps of a qdisc.

    Attributes:
        applied: Steps that were put into force.
        late: Those of them that were later than `LATE_NS`.
        passed_over: Steps of the time line that were over before their turn came.
    """

    def __init__(self) -> None:
        self.applied = self.late = self.passed_over = 0
        self._lateness_ns: deque[int] = deque(maxlen=_KEPT)

    def note(self, lateness_ns: int, passed_over: int) -> None:
        """Note a step.

        Args:
            lateness_ns: From when it was due until tc said that it is in force [ns].
            passed_over: Steps between the one before and this one.
        """
        self.applied += 1
        self.late += lateness_ns > LATE_NS
        self.passed_over += passed_over
        self._lateness_ns.append(lateness_ns)

    def lateness_ns(self) -> tuple[int, int]:
        """Give median and 99th percentile of the last 10,000 latenesses [ns]; 0 without any."""
        ordered = sorted(self._lateness_ns) or [0]
        return ordered[(len(ordered) - 1) // 2], ordered[ceil(0.99 * (len(ordered) - 1))]

    def counts(self) -> dict[str, int]:
        """Say how many steps there were and how late they were; empty before the first."""
        if not self.applied:
            return {}
        median_ns, worst_ns = self.lateness_ns()
        return {
            "steps": self.applied,
            "steps_late": self.late,
            "steps_passed_over": self.passed_over,
            "step_lateness_p50_ns": median_ns,
            "step_lateness_p99_ns": worst_ns,
        }

    def in_words(self) -> str:
        """Say how it went."""
        median, worst = (late_ns * 1e-6 for late_ns in self.lateness_ns())
        over = f", {self.passed_over} passed over" if self.passed_over else ""
        return (
            f"{self.applied} steps of the time line, late by {median:.2f} ms in the median and "
            f"{worst:.2f} ms at the 99th percentile, {self.late} above {LATE_NS * 1e-6:g} ms{over}"
        )


def pause_ns(due_ns: int, stepped_ns: int) -> int:
    """Say when the step due at `due_ns` may be taken after one at `stepped_ns` [ns]."""
    return max(due_ns, stepped_ns + STEP_NS)
