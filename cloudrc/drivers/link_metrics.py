"""Export state and counters of a link as metrics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from cloudrc.link.state import LinkState
from cloudrc.records import Counted

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter


def export_state(exporter: Exporter | None, state: LinkState) -> None:
    """Export the state of one direction as metrics."""
    if exporter:
        delay = state.asked["delay"] or 0.0
        exporter.link.shaped(state.shaper, state.direction, state.mode, delay)
        exporter.ready(True)


def export_counts(exporter: Exporter | None, counts: dict[str, int]) -> None:
    """Export the counters of a shaper as metrics; `counts`: name of the counter -> value."""
    if exporter:
        exporter.see([Counted(0, "link", name, number) for name, number in counts.items()])
