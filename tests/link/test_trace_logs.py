# SPDX-License-Identifier: Apache-2.0

"""Logs of ping, irtt and CSV: units, losses, directions; unused rows are counted."""

import json
from math import isnan, nan

import numpy as np
import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.link.trace_logs import (
    Packets,
    is_ping,
    read_csv,
    read_irtt,
    read_ping,
    trace_of,
)


def read(text, *, halve=False):
    return read_csv(text.splitlines(), "x.csv", halve=halve)


def delays_of(packets):
    """Return the delays [s], None for a lost packet."""
    return [None if isnan(delay) else delay for delay in packets.delays.tolist()]


def test_a_row_of_a_trace_begins_halfway_between_two_packets():
    def trace_of_log(sent, delays):
        return trace_of(Packets(np.array(sent), np.array(delays), np.isfinite(delays).astype(int)))

    trace = trace_of_log((5.0, 5.01, 5.02, 5.03), (0.040, nan, 0.060, 0.045))
    assert trace.times == pytest.approx((0.0, 0.005, 0.015, 0.025))
    assert trace.delays == (0.040, 0.040, 0.060, 0.045)
    assert trace.losses == (0.0, 1.0, 0.0, 0.0)
    assert trace_of_log((0.0, 1.0), (0.040, 0.050)).losses is None
    assert trace_of_log((0.0, 1.0), (nan, 0.050)).delays == (0.050, 0.050)


@pytest.mark.parametrize(
    ("text", "delays", "notes"),
    [
        (
            "host,delay_s,sent_us,status\na,0.045,1000000,ok\n\nb,0.060,1500000,late",
            (0.045, 0.060),
            ("columns left out: host, status",),
        ),
        ("time_ns,rtt_ns\n1700000000000000000,9e7\n1700000000500000000,", (0.045, None), ()),
        ("time_s,delay_ms,lost\n0,45,0\n0.5,0,1", (0.045, None), ()),
        ("time_s;rtt_ms;received\n0;90;1\n0.5;0;0", (0.045, None), ()),
    ],
)
def test_units_and_losses_are_those_of_the_columns(text, delays, notes):
    packets = read(text, halve=True)
    assert packets.sent == pytest.approx((0.0, 0.5))
    assert delays_of(packets) == pytest.approx(delays)
    assert packets.notes == notes


def test_round_trips_are_halved_only_on_request():
    with pytest.raises(InvalidValueError, match=r"column rtt_ms: has round trips; .*--halve-rtt"):
        read("time_s,rtt_ms\n0,90")
    with pytest.raises(InvalidValueError, match=r"ping measures round trips; .*--halve-rtt"):
        read_ping(list(PING), halve=False)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("time_s,delay_ms,loss\n0,45,0.1", "line 2: loss: '0.1' is not a whole number"),
        ("time_s,delay_ms,loss%\n0,45,1", "column loss%: is a share in percent, but here a row is"),
        ("time_s,delay_ms,received\n0,45,7", "line 2: received: '7' is not a whole number"),
        ("time_s,delay_ms\n0,45\n1,-3", "arrived 3 ms before it was sent: the two clocks differ;"),
        ("time_s,delay_ms\n98,4\n99,4\n100,4\n0,4\n1,4", "at packet 4 the times go back by 100 s"),
    ],
)
def test_an_unusable_csv_log_is_refused(text, says):
    with pytest.raises((BadInputError, InvalidValueError), match=says):
        read(text)


def trip(number, lost=False, send=30, receive=20):
    """Make a round trip as irtt 0.9 writes it; delays in [ms], one packet every 10 ms."""
    at, send, receive = number * 10_000_000, send * 1_000_000, receive * 1_000_000
    wall = 1_700_000_000_000_000_000 + at
    stamps = {"client": {"send": {"wall": wall, "monotonic": 5_000 + at}}}
    if lost:
        return {"lost": lost, "timestamps": stamps}
    stamps["server"] = {"receive": {"wall": wall + send, "monotonic": at + send}}
    delay = {"send": send, "receive": receive, "rtt": send + receive}
    return {"lost": "false", "timestamps": stamps, "delay": delay}


def irtt(trips, direction=None):
    text = json.dumps({"round_trips": trips})
    return read_irtt(text, direction, halve=direction is None)


TRIPS = [trip(0), trip(1, "true_up"), trip(2, "true_down"), trip(3, True), trip(4, send=35)]


@pytest.mark.parametrize(
    ("direction", "sent", "delays"),
    [
        ("uplink", (0.0, 0.010, 0.020, 0.030, 0.040), (0.030, None, None, None, 0.035)),
        ("downlink", (0.0, 0.020, 0.030, 0.040), (0.020, None, None, 0.020)),
        (None, (0.0, 0.010, 0.020, 0.030, 0.040), (0.025, None, None, None, 0.0275)),
    ],
)
def test_irtt_gives_the_delays_of_each_direction(direction, sent, delays):
    """A packet lost on the way back has arrived; one that never arrived is not sent back."""
    packets = irtt(TRIPS, direction)
    assert packets.sent == pytest.approx(sent)
    assert delays_of(packets) == pytest.approx(delays)
    unknown = ("1 lost on the way back, delay unknown",) * (direction == "uplink")
    assert packets.notes == unknown
    lost = [n for n, copies in enumerate(packets.copies) if not copies]
    assert lost == {"uplink": [1, 3], "downlink": [1, 2], None: [1, 2, 3]}[direction]


@pytest.mark.parametrize("direction", ["uplink", "downlink"])
def test_irtt_without_good_clocks_is_refused(direction):
    with pytest.raises(
        InvalidValueError, match="arrived 5 ms before it was sent: the two clocks dif"
    ):
        irtt([trip(0, send=60, receive=-5)], direction)
    unstamped = trip(0)
    del unstamped["delay"]["send"]
    with pytest.raises(InvalidValueError, match=r"server's stamps or with --halve-rtt"):
        irtt([unstamped], direction)


HEAD = "PING 192.0.2.1 (192.0.2.1) 56(84) bytes of data."


def reply(number, stamp, time="20.0", end=""):
    return f"[{stamp:.6f}] 64 bytes from 192.0.2.1: icmp_seq={number} ttl=57 time={time} ms{end}"


def ping(*lines):
    assert is_ping(list(lines))
    return read_ping(list(lines), halve=True)


PING = (
    HEAD,
    reply(1, 100.04, "40.0"),
    reply(2, 100.23, "30").replace("192.0.2.1", "host.example (192.0.2.1)"),
    "[100.600000] no answer yet for icmp_seq=3",
    reply(4, 100.7, "100"),
    reply(4, 100.71, "110", " (DUP!)"),
    "[101.000000] no answer yet for icmp_seq=5",
)
END = (
    "--- 192.0.2.1 ping statistics ---",
    "6 packets transmitted, 3 received, +1 duplicates, 40% packet loss, time 1000ms",
    "rtt min/avg/max/mdev = 30.0/70.0/110.0/30.9 ms",
)


@pytest.mark.parametrize(("end", "lost"), [((), 2), (END, 3)])
def test_ping_gives_half_round_trips_at_the_time_of_sending(end, lost):
    """Only the summary counts a packet after the last line."""
    packets = ping(*PING, *end)
    assert packets.sent == pytest.approx((100.0, 100.2, 100.4, 100.6, 100.8, 101.0)[: 3 + lost])
    assert delays_of(packets)[:5] == pytest.approx((0.020, 0.015, None, 0.050, None))
    assert delays_of(packets).count(None) == lost
    assert packets.notes == ()


def test_ping_counts_on_after_65535():
    """A late reply from before the wrap keeps its place."""
    packets = ping(reply(65534, 1.0), reply(0, 3.0), reply(65535, 2.0), reply(1, 4.0))
    assert packets.sent == pytest.approx((0.98, 1.98, 2.98, 3.98))


@pytest.mark.parametrize(
    "line", [reply(1, 1.0)[11:], "Antwort von 192.0.2.7: Bytes=32 Zeit<1ms TTL=57"]
)
def test_another_ping_or_language_is_refused_with_what_works(line):
    with pytest.raises(InvalidValueError, match=r"LC_ALL=C ping -D -O HOST; Apple's .* irtt"):
        ping(line)
