"""What the emulated link exposes: who shapes which direction, and what became of the datagrams."""

from __future__ import annotations

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


class Link:
    """One process that shapes one direction or both."""

    def __init__(self) -> None:
        """Begin before anything is shaped."""
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
        } | (self._released() | self._stepped() | self._restored())

    def _stepped(self) -> Readings:
        """Say how late a qdisc was stepped; empty if none was."""
        counts = dict(self._counts)
        named = {label: f"step_lateness_{name}_ns" for label, name in STEP_PERCENTILES.items()}
        late = {label: counts[name] * 1e-9 for label, name in named.items() if name in counts}
        return {"cloudrc_link_step_lateness_seconds": by(late)}

    def _restored(self) -> Readings:
        """Say how often netem was put back; empty if no netem has told."""
        restored = self._counts.get("restored")
        return {} if restored is None else {"cloudrc_link_restored_total": plain(restored)}

    def _released(self) -> Readings:
        """Say how late a relay was; empty if no relay has told."""
        counts = dict(self._counts)  # copied at once: the other thread may go on
        named = {label: f"release_error_{name}_ns" for label, name in RELEASE_PERCENTILES.items()}
        late = {label: counts[name] * 1e-9 for label, name in named.items() if name in counts}
        return {"cloudrc_link_release_error_seconds": by(late)}
