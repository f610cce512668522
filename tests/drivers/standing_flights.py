"""Flights that the standing check hears, drawn without any flight: what an end notes of a link."""

from __future__ import annotations

from collections.abc import Iterable

from virtual_netem import VirtualNetem

from cloudrc.assembly import link_profile
from cloudrc.config.load import load_profile
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify.monitor import StandingCheck
from cloudrc.link.verify.twin import Stream
from cloudrc.records import Arrival, Fault, Lateness, LinkChecked, Record

PERIOD_NS = 10_000_000
COMMAND, SIZE = 4, 88
TELEMETRY, TELEMETRY_SIZE = 3, 203
PAPER = link_profile(load_profile("paper-p2").downlink)
P1 = link_profile(load_profile("paper-p1").downlink)
LOSSY = link_profile(load_profile("lossy").downlink)
SATELLITE = link_profile(load_profile("satellite").downlink)
HANDOVER = link_profile(load_profile("handover").downlink)
ZERO = (0.0, 0.0, 0.0)
DRAWS = Stream(1, False, COMMAND, SIZE)
"""Seed 1 is the experiment's; links of another seed draw otherwise, as netem does."""


def arrivals(
    profile: DirectionProfile,
    seconds: float = 60.0,
    *,
    seed: int = 1,
    overhead: float = 5e-4,
    uplink: bool = False,
    netem: bool = False,
) -> list[Arrival]:
    """What an end notes of a minute of datagrams over a link.

    Args:
        profile: Of the link.
        seconds: How long [s].
        seed: Of its chance.
        overhead: What the ends add [s]; NaN: they share no clock.
        uplink: Whether cloud hears telemetry; else world hears commands.
        netem: Whether netem shapes, which draws as the kernel does.
    """
    model = LinkDirection(profile, seed, uplink=uplink)
    link = VirtualNetem(profile, seed) if netem else model
    kind, size = (TELEMETRY, TELEMETRY_SIZE) if uplink else (COMMAND, SIZE)
    found, whole = [], bytes(size)
    for n in range(round(seconds * 100)):
        sent_ns = n * PERIOD_NS
        fate = link.send(1, kind, n, size, sent_ns)
        if link is model and model.corrupts and model.corrupted(1, kind, n, whole) != whole:
            continue  # its tag does not fit: refused
        for at_ns in fate:
            delay = (at_ns - sent_ns) * 1e-9 + overhead
            found.append(Arrival(at_ns, uplink, 1, n, delay, True))
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
    return hearing(asked, uplink=False)


def punctual(arrivals: Iterable[Arrival], late: float = 1e-4, busy: float = 1e-4) -> list[Record]:
    """Add what an end tells of its wakes, one per arrival: how late, and how long busy [s]."""
    heard: list[Record] = []
    for arrival in arrivals:
        heard += [arrival, Lateness(arrival.stamp_ns, "cloud", late, busy, 0)]
    return heard


def hearing(asked: DirectionProfile, uplink: bool) -> StandingCheck:
    """The check of the end that hears this direction."""
    draws = Stream(1, True, TELEMETRY, TELEMETRY_SIZE) if uplink else DRAWS
    check = StandingCheck(uplink=uplink, stream=draws)
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
