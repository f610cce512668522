"""What the emulated link exposes: who shapes which direction, and what became of the datagrams."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from cloudrc.exposition.labels import (
    DIRECTIONS,
    LINK_MODES,
    LINK_OUTCOMES,
    RELEASE_PERCENTILES,
    SHAPERS,
    STEP_PERCENTILES,
    Labels,
)
from cloudrc.exposition.part import Handlers, Readings, by, chosen, plain
from cloudrc.records import Counted

_OF_ONE_SHAPER = {
    "cloudrc_link_restored_total": "restored",
    "cloudrc_link_released_early_total": "released_early",
}
"""Metric -> what the one shaper that knows it calls the count."""


class Link:
    """One process that shapes one direction or both.

    Attributes:
        tell: Says as JSON what its metrics have no words for.
    """

    def __init__(self) -> None:
        """Begin before anything is shaped."""
        self.tell: Callable[[], str] = lambda: "{}\n"
        self._shapers: dict[str, Labels] = {}
        self._delays: dict[str, float] = {}
        self._counts: dict[str, int] = {}

    def handlers(self) -> Handlers:
        """See `Part`."""
        return {Counted: self._see_count}

    def shaped(self, shaper: str, direction: str, mode: str) -> None:
        """Say who shapes a direction from now on.

        Args:
            shaper: "relay" or "netem".
            direction: "uplink" or "downlink".
            mode: What was asked for: "auto", "relay" or "netem".
        """
        assert shaper in SHAPERS
        assert direction in DIRECTIONS
        assert mode in LINK_MODES
        self._shapers[direction] = (shaper, direction, mode)

    def asked(self, direction: str, delay: float) -> None:
        """Say which mean delay [s] a direction is asked to have from now on."""
        assert direction in DIRECTIONS
        self._delays[direction] = delay

    def _see_count(self, record: Counted) -> None:
        self._counts[record.name] = record.total

    def read(self) -> Readings:
        """See `Part`."""
        return {
            "cloudrc_link_info": dict.fromkeys(list(self._shapers.values()), 1.0),
            "cloudrc_link_delay_seconds": by(dict(self._delays)),
            "cloudrc_link_datagrams_total": by(chosen(LINK_OUTCOMES, self._counts)),
            "cloudrc_dns_errors_total": plain(self._counts.get("unresolved", 0)),
            "cloudrc_link_release_error_seconds": self._late("release_error", RELEASE_PERCENTILES),
            "cloudrc_link_step_lateness_seconds": self._late("step_lateness", STEP_PERCENTILES),
        } | self._of_one_shaper()

    def _of_one_shaper(self) -> Readings:
        """Count what netem or the relay alone can tell; what nobody has told is not there."""
        counts = dict(self._counts)  # copied at once: the other thread may go on
        return {name: plain(counts[one]) for name, one in _OF_ONE_SHAPER.items() if one in counts}

    def _late(self, what: str, percentiles: Mapping[str, str]) -> dict[Labels, float]:
        """Say how late a relay was, or a qdisc was stepped [s]; empty if nobody has told."""
        counts = dict(self._counts)  # copied at once: the other thread may go on
        named = {label: f"{what}_{name}_ns" for label, name in percentiles.items()}
        return by({label: counts[name] * 1e-9 for label, name in named.items() if name in counts})
