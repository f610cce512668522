"""Flights that the standing check hears, drawn without any flight: what an end notes of a link."""

from __future__ import annotations

from collections.abc import Iterable

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.drivers.standing_check import StandingCheck
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify_twin import Stream
from cloudrc.records import Arrival, Fault, LinkChecked, Record

PERIOD_NS = 10_000_000
COMMAND, SIZE = 4, 88
PAPER = link_profile(load_profile("paper-p2").downlink)
P1 = link_profile(load_profile("paper-p1").downlink)
LOSSY = link_profile(load_profile("lossy").downlink)
SATELLITE = link_profile(load_profile("satellite").downlink)
HANDOVER = link_profile(load_profile("handover").downlink)
WHOLE = bytes(SIZE)
ZERO = (0.0, 0.0, 0.0)
DRAWS = Stream(1, False, COMMAND, SIZE)
"""Seed 1 is the experiment's; links of another seed draw otherwise, as netem does."""


def arrivals(
    profile: DirectionProfile, seconds: float = 60.0, *, seed: int = 1, overhead: float = 5e-4
) -> list[Arrival]:
    """What world notes of a minute of commands over a link; NaN overhead: no shared clock."""
    link = LinkDirection(profile, seed, uplink=False)
    found = []
    for n in range(round(seconds * 100)):
        sent_ns = n * PERIOD_NS
        fate = link.send(1, COMMAND, n, SIZE, sent_ns)
        if fate and link.corrupts and link.corrupted(1, COMMAND, n, WHOLE) != WHOLE:
            continue  # its tag does not fit: refused
        for at_ns in fate:
            delay = (at_ns - sent_ns) * 1e-9 + overhead
            found.append(Arrival(at_ns, False, 1, n, delay, True))
    return sorted(found)


def checked(
    check: StandingCheck, records: Iterable[Record], since_ns: int = 0
) -> tuple[list[LinkChecked], list[Fault]]:
    """Hand over records one by one, as a loop does."""
    said: list[Record] = []
    for record in records:
        said += check.after([record], record.stamp_ns + since_ns)
    return (
        [one for one in said if isinstance(one, LinkChecked)],
        [one for one in said if isinstance(one, Fault)],
    )


def downlink(asked: DirectionProfile) -> StandingCheck:
    check = StandingCheck(uplink=False, stream=DRAWS)
    check.follow((asked, asked))
    return check


def newest(records: list[LinkChecked]) -> dict[str, LinkChecked]:
    last = max((record.stamp_ns for record in records), default=0)
    return {record.quantity: record for record in records if record.stamp_ns == last}


def believed(records: list[LinkChecked]) -> bool:
    """Whether the newest verdict is that all is as asked."""
    return {record.verdict for record in newest(records).values()} - {"told"} == {"ok"}


def moments(records: list[LinkChecked]) -> list[list[LinkChecked]]:
    """The verdicts, one after the other."""
    stamps = sorted({record.stamp_ns for record in records})
    return [[one for one in records if one.stamp_ns == stamp] for stamp in stamps]
