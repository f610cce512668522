"""What an end tells of the standing check of the link: the verdict, and all of it as JSON."""

from __future__ import annotations

import json
from math import isfinite

from cloudrc.exposition.part import Readings
from cloudrc.records import LinkChecked

_KNOWN = ("stamp_ns", "uplink")
"""Of no use to a reader, or said once for all."""


class Check:
    """The newest verdict on the direction that an end hears."""

    def __init__(self, direction: str) -> None:
        """Begin before the first; the direction is "uplink" or "downlink"."""
        self._direction = direction
        self._newest: tuple[LinkChecked, ...] = ()

    def see(self, record: LinkChecked) -> None:
        """Take note of one quantity; those of an older verdict are forgotten."""
        newest = self._newest
        if newest and newest[0].stamp_ns != record.stamp_ns:
            newest = ()
        self._newest = (*newest, record)  # replaced, not changed: others may be reading it

    @property
    def verdict(self) -> str:
        """Of all quantities: "ok", "off", or "open" while there is too little to say."""
        verdicts = {record.verdict for record in self._newest} - {"told"}
        return "off" if "off" in verdicts else "ok" if verdicts == {"ok"} else "open"

    def text(self) -> str:
        """Say all that is known now, as JSON."""
        rows = [
            {
                key: value
                for key, value in record._asdict().items()
                if key not in _KNOWN and not (isinstance(value, float) and not isfinite(value))
            }
            for record in self._newest
        ]
        found = {"direction": self._direction, "verdict": self.verdict, "rows": rows}
        return json.dumps(found, indent=2) + "\n"

    def read(self) -> Readings:
        """See `Part`."""
        if self.verdict == "open":
            return {}
        return {"cloudrc_link_believed": {(self._direction,): float(self.verdict == "ok")}}
