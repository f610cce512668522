"""Packets become rows that a stream of the same rate meets one by one; wrong units are rejected."""

from __future__ import annotations

import pytest

from cloudrc.errors import BadInputError
from cloudrc.link.traces import Packets, check_unit, in_order, parse_trace, trace_of, write_trace

STREAM = Packets((5.0, 5.01, 5.02, 5.03), (0.040, None, 0.060, 0.045))


def test_a_row_begins_halfway_between_two_packets() -> None:
    trace = trace_of(STREAM)
    assert trace.times == pytest.approx((0.0, 0.005, 0.015, 0.025))
    assert trace.delays == (0.040, 0.040, 0.060, 0.045)
    assert trace.losses == (0.0, 1.0, 0.0, 0.0)


def test_a_stream_without_losses_has_no_such_column() -> None:
    trace = trace_of(Packets((0.0, 1.0), (0.040, 0.050)))
    assert trace.losses is None
    assert write_trace(trace) == "time_s,delay_ms\n0,40\n0.5,50\n"


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_what_is_written_is_read_again(scale: float) -> None:
    delays = tuple(delay and delay * scale for delay in STREAM.delays)
    trace = trace_of(Packets(STREAM.sent, delays))
    again = parse_trace(write_trace(trace).splitlines(), "x")
    assert again.times == pytest.approx(trace.times)
    assert again.delays == pytest.approx(trace.delays)
    assert again.losses == trace.losses


def test_packets_are_put_in_the_order_of_sending() -> None:
    packets = in_order([(2.0, 0.1), (1.0, None), (2.0, 0.9)], "x")
    assert packets == Packets((1.0, 2.0), (None, 0.1))
    assert (packets.lost, packets.duration) == (1, 1.0)


def test_nothing_arrived_or_arrived_before_it_was_sent() -> None:
    with pytest.raises(BadInputError, match="no packet arrived"):
        in_order([(0.0, None)], "x")
    with pytest.raises(BadInputError, match=r"arrived 3 ms before it was sent.*--halve-rtt"):
        in_order([(0.0, -0.003), (1.0, 0.01)], "x")


@pytest.mark.parametrize(
    ("delay", "unit", "says"),
    [
        (45e-6, "ms", "is at most 0.045 ms, which looks like seconds; name the column"),
        (0.5e-6, "us", "is at most 0.5 us"),
        (45.0, "s", "has a median of 45 s, which looks like ms"),
        (45.0, "ms", "has a median of 45000 ms, which looks like us"),
    ],
)
def test_a_delay_in_another_unit_is_refused(delay: float, unit: str, says: str) -> None:
    with pytest.raises(BadInputError, match=says):
        check_unit(Packets((0.0, 1.0), (delay, delay)), unit, "x.csv: delay")


@pytest.mark.parametrize(("delay", "unit"), [(0.045, "s"), (0.045, "ms"), (45e-6, "us"), (0, "ms")])
def test_a_plausible_delay_passes(delay: float, unit: str) -> None:
    check_unit(Packets((0.0, 1.0), (delay, None)), unit, "x.csv: delay")
