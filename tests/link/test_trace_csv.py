"""CSV logs: columns with units, losses, and rejected files."""

from __future__ import annotations

import pytest

from cloudrc.errors import BadInputError
from cloudrc.link.traces import Packets, read_csv


def read(text: str, *, halve: bool = False, trust_units: bool = False) -> Packets:
    return read_csv(text.splitlines(), "x.csv", halve=halve, trust_units=trust_units)


@pytest.mark.parametrize(
    "text",
    [
        "time_s,delay_ms\n10,45\n10.5,60",
        "time_ms, delay_us\n10000, 45000\n10500, 60000",
        "host,delay_s,sent_us,note\na,0.045,1000000,x\n\nb,0.060,1500000,y",
        "timestamp_ns,delay_ns\n1700000000000000000,45000000\n1700000000500000000,60000000",
    ],
)
def test_the_units_are_those_of_the_columns(text: str) -> None:
    packets = read(text)
    assert packets.sent == pytest.approx((0.0, 0.5))
    assert packets.delays == pytest.approx((0.045, 0.060))


@pytest.mark.parametrize("row", ["1,,0", "1,nan,0", "1,-,0", "1,30,1"])
def test_what_has_no_delay_or_is_marked_is_lost(row: str) -> None:
    assert read(f"time_s,delay_ms,loss\n0,45,0\n{row}\n2,46,0").delays == pytest.approx(
        (0.045, None, 0.046)
    )


def test_round_trips_are_halved_if_asked_only() -> None:
    assert read("time_s,rtt_ms\n0,90\n1,80", halve=True).delays == pytest.approx((0.045, 0.040))
    with pytest.raises(BadInputError, match=r"column rtt_ms: has round trips; .*--halve-rtt"):
        read("time_s,rtt_ms\n0,90")


def test_one_way_delays_are_not_halved() -> None:
    assert read("time_s,delay_ms\n0,90\n1,80", halve=True).delays == pytest.approx((0.090, 0.080))


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time_s,delay_ms\n0,0.045\n1,0.07", "delay_ms is at most 0.07 ms, which looks like sec"),
        ("time_s,delay_s\n0,45\n1,70", "delay_s has a median of 57.5 s, which looks like ms"),
        ("time_s,delay_ms\n1700000000000,45", "time_s is 1700000000000, a finer unit than s"),
        ("time,delay_ms\n0,45", "column time does not say its unit; call it time_s, time_ms"),
        ("time_s,delay\n0,45", "column delay does not say its unit"),
        ("time_s,latency\n0,45", "no column delay, found time_s,latency; name them time_s"),
        ("delay_ms\n45", "no column time"),
        ("", "no column time, found nothing"),
        ("time_s,delay_ms,rtt_ms\n0,45,90", "has delay_ms and rtt_ms; keep only one"),
        ("time_s,delay_ms\n0,45\n1,fast", "line 3: delay_ms is 'fast'; give a number"),
        ("time_s,delay_ms\n,45", "line 2: time_s is nothing; give a number"),
        ("time_s,delay_ms\ninf,45", "line 2: time_s is inf; give a number"),
        ("time_s,delay_ms,loss\n0,45,0.5", "line 2: loss is 0.5; give 0 or 1"),
        ("time_s,delay_ms\n0,45\n1,-3", "arrived 3 ms before it was sent"),
        ("time_s,delay_ms", "no packet arrived"),
        ("time_s,delay_ms\n0," + "9" * 200_000, "field larger than field limit"),
    ],
)
def test_what_cannot_be_used_is_refused(text: str, says: str) -> None:
    with pytest.raises(BadInputError) as caught:
        read(text)
    assert str(caught.value).startswith("x.csv")
    assert says in str(caught.value)
    assert "\n" not in str(caught.value)


def test_units_are_trusted_if_the_user_says_so() -> None:
    packets = read("time_s,delay_ms\n0,0.045\n1,0.07", trust_units=True)
    assert packets.delays == pytest.approx((45e-6, 70e-6))
