"""How two clocks lie to each other: both ends' recordings go in, world's minus cloud's comes out.

No packet arrives before it was sent. So each telemetry says that world's clock is ahead of cloud's
by at least (sent - arrived), each command by at most (arrived - sent); the quickest packets each
way leave the narrowest interval, as wide as the smallest round trip without any hold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cloudrc.record.columns import Recording, Table
from cloudrc.record.topics import TOPICS


@dataclass(frozen=True, slots=True)
class ClockOffset:
    """World's clock minus cloud's.

    Attributes:
        offset_ns: To add to cloud's stamps [ns].
        uncertainty_ns: The true offset is within this of it [ns]; None if that is not known.
        method: "same clock"; "packets" if estimated from both ways; "first records" if nothing
            relates the clocks and both recordings are taken to begin together.
    """

    offset_ns: int
    uncertainty_ns: int | None
    method: Literal["same clock", "packets", "first records"]

    def metadata(self) -> dict[str, str]:
        """Write it down for a file's metadata; an unknown uncertainty is absent."""
        noted = {"clock_offset_ns": str(self.offset_ns), "clock_offset_method": self.method}
        if self.uncertainty_ns is not None:
            noted["clock_offset_uncertainty_ns"] = str(self.uncertainty_ns)
        return noted


SAME_CLOCK = ClockOffset(0, 0, "same clock")


def clock_offset(world: Recording, cloud: Recording) -> ClockOffset:
    """Find out how to put cloud's stamps on world's clock.

    Source: the clock filter of RFC 5905 (NTP), section 10: the sample of the smallest round trip,
        half of which bounds the error.
    Deviation: the two ways are minimised apart, so that the quickest packet of each counts; clock
        drift is not modelled (50 ppm are 3 ms in a minute).

    Args:
        world: What world recorded, on its clock.
        cloud: What cloud recorded, on its clock.

    Returns:
        The identity if both name the same clock; else the middle of what the packets allow.
    """
    clock_id = world.metadata.get("clock_id")
    if clock_id and clock_id == cloud.metadata.get("clock_id"):
        return SAME_CLOCK
    uplink = _smallest_difference(world["/telemetry"], cloud["/uplink_delay"])
    downlink = _smallest_difference(cloud["/delay_estimate"], world["/downlink_delay"])
    if uplink is None or downlink is None:
        return ClockOffset(_first_ns(world) - _first_ns(cloud), None, "first records")
    # uplink = d1 - offset and downlink = d2 + offset, where d1, d2 >= 0 are one-way delays.
    uncertainty_ns = (abs(downlink + uplink) + 1) // 2
    return ClockOffset((downlink - uplink) // 2, uncertainty_ns, "packets")


def _smallest_difference(sent: Table, arrived: Table) -> int | None:
    """Find the smallest arrival minus departure [ns], each on its own clock."""
    departures = dict(zip(_names(sent), sent["stamp_ns"].tolist(), strict=True))
    differences = [
        stamp_ns - departures[name]
        for name, stamp_ns in zip(_names(arrived), arrived["stamp_ns"].tolist(), strict=True)
        if name in departures
    ]
    return min(differences, default=None)


def _names(table: Table) -> list[tuple[int, int]]:
    return list(zip(table["epoch"].tolist(), table["counter"].tolist(), strict=True))


def _first_ns(recording: Recording) -> int:
    stamps = [int(recording[topic]["stamp_ns"][0]) for topic in TOPICS if len(recording[topic])]
    return min(stamps, default=0)
