"""What became of packets sent one after the other: a log's packets go in, a trace comes out.

All sources of a trace (a run, ping, irtt, CSV) are read into this form. A packet has one way to
go: a round trip is halved before it gets here, and only if the user says so.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from operator import itemgetter
from statistics import median

from cloudrc.errors import BadInputError
from cloudrc.link.profile import Trace

LONGEST = 5.0
"""Half of the delays above this [s] are more likely another unit than a network."""


@dataclass(frozen=True, slots=True)
class Packets:
    """Packets in the order in which they were sent.

    Attributes:
        sent: When each left, on any clock, strictly rising [s], shape (n,).
        delays: One way [s], None for the lost, shape (n,).
    """

    sent: tuple[float, ...]
    delays: tuple[float | None, ...]

    @property
    def arrived(self) -> list[float]:
        """Delays of those that arrived [s]."""
        return [delay for delay in self.delays if delay is not None]

    @property
    def lost(self) -> int:
        """How many did not arrive."""
        return len(self.delays) - len(self.arrived)

    @property
    def duration(self) -> float:
        """From the first to the last that was sent [s]."""
        return self.sent[-1] - self.sent[0]


def in_order(entries: Iterable[tuple[float, float | None]], name: str) -> Packets:
    """Put packets in the order of sending; of two sent at one instant the first stays.

    Args:
        entries: When sent [s] and delay [s], None if lost, in any order.
        name: Of the source, for messages.

    Raises:
        BadInputError: If none arrived, or if a delay is negative.
    """
    unique: dict[float, float | None] = {}
    for sent, delay in entries:
        unique.setdefault(sent, delay)
    ordered = sorted(unique.items(), key=itemgetter(0))
    packets = Packets(tuple(s for s, _ in ordered), tuple(d for _, d in ordered))
    arrived = packets.arrived
    if not arrived:
        raise BadInputError(f"{name}: no packet in it arrived; there is nothing to make a trace of")
    if min(arrived) < 0.0:
        raise BadInputError(
            f"{name}: a packet arrived {-min(arrived) * 1e3:.4g} ms before it was sent: the two "
            "clocks differ; synchronise them, or take half of each round trip with --halve-rtt"
        )
    return packets


def check_unit(packets: Packets, unit: str, name: str) -> None:
    """Refuse delays that look as if they were in another unit.

    Args:
        packets: As read.
        unit: That they were taken to be in: s, ms, us or ns.
        name: Of the source and its column, for messages.

    Raises:
        BadInputError: Says which unit they are likely to be in.
    """
    factor = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit]
    top, middle = max(packets.arrived), median(packets.arrived)
    remedy = "name the column after its unit, or say --trust-units"
    if unit != "s" and 0.0 < top * factor < 1.0:
        raise BadInputError(
            f"{name} is {top * factor:.4g} {unit} at most, which looks like seconds; {remedy}"
        )
    if middle > LONGEST:
        finer = {"s": "ms", "ms": "us", "us": "ns", "ns": "ns"}[unit]
        raise BadInputError(
            f"{name} is {middle * factor:.6g} {unit} in the middle, which looks like {finer}; "
            f"{remedy}"
        )


def trace_of(packets: Packets) -> Trace:
    """Make a trace that gives a stream of the same rate the same delays and losses.

    A row holds until the next, so each begins halfway between its packet and the one before: a
    replayed packet may be late or early by up to half a period and still meets its own row. Time
    begins with the first packet.

    Returns:
        One row per packet; the losses are None if nothing was lost.
    """
    sent = packets.sent
    times = [0.0]
    times += [(before + after) / 2 - sent[0] for before, after in pairwise(sent)]
    delays = []
    delay = packets.arrived[0]
    for given in packets.delays:
        delay = delay if given is None else given
        delays.append(delay)
    losses = tuple(1.0 if given is None else 0.0 for given in packets.delays)
    return Trace(tuple(times), tuple(delays), losses if packets.lost else None)


def write_trace(trace: Trace) -> str:
    """Write a trace as the CSV that `trace.read_trace` reads.

    Where all delays are below 1 ms the column is `delay_us`, since the reader takes such
    milliseconds for mistaken seconds.
    """
    short = 0.0 < max(trace.delays) < 1e-3
    unit, scale = ("us", 1e6) if short else ("ms", 1e3)
    lines = [f"time_s,delay_{unit}" + ",loss" * (trace.losses is not None)]
    for row, (time, delay) in enumerate(zip(trace.times, trace.delays, strict=True)):
        loss = "" if trace.losses is None else f",{trace.losses[row]:g}"
        lines.append(f"{_short(time, 9)},{_short(delay * scale, 6)}{loss}")
    return "\n".join(lines) + "\n"


def _short(value: float, digits: int) -> str:
    """Write a number with at most so many decimals, none of them a zero at the end."""
    return f"{value:.{digits}f}".rstrip("0").rstrip(".")
