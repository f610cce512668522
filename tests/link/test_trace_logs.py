"""Logs of ping and irtt: replies, losses, directions and missing data."""

from __future__ import annotations

import json
from typing import Any

import pytest

from cloudrc.errors import BadInputError
from cloudrc.link.traces import Direction, is_ping, read_irtt, read_ping

PING = """\
PING 192.0.2.1 (192.0.2.1) 56(84) bytes of data.
[100.040000] 64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=40.0 ms
[100.230000] 64 bytes from host.example (192.0.2.1): icmp_seq=2 ttl=57 time=30 ms
[100.410000] no answer yet for icmp_seq=3
[100.700000] 64 bytes from 192.0.2.1: icmp_seq=4 ttl=57 time=100 ms
[100.710000] 64 bytes from 192.0.2.1: icmp_seq=4 ttl=57 time=110 ms (DUP!)
[100.900000] no answer yet for icmp_seq=5

--- 192.0.2.1 ping statistics ---
5 packets transmitted, 3 received, +1 duplicates, 40% packet loss, time 800ms
rtt min/avg/max/mdev = 30.0/56.6/100.0/30.9 ms
""".splitlines()


def reply(sequence: int, stamp: float) -> str:
    return f"[{stamp:.6f}] 64 bytes from 192.0.2.1: icmp_seq={sequence} ttl=57 time=20.0 ms"


def test_ping_gives_halves_sent_when_the_request_left() -> None:
    """A number without a reply is lost; after the last reply nothing is known."""
    packets = read_ping(PING, "x", halve=True)
    assert packets.sent == pytest.approx((100.0, 100.2, 100.4, 100.6))
    assert packets.delays == pytest.approx((0.020, 0.015, None, 0.050))


def test_ping_is_not_halved_unasked() -> None:
    with pytest.raises(BadInputError, match=r"ping measures round trips; .*--halve-rtt"):
        read_ping(PING, "x", halve=False)


def test_ping_counts_on_after_65535() -> None:
    """A late reply from before the wrap keeps its place."""
    lines = [reply(65534, 1.0), reply(0, 3.0), reply(65535, 2.0), reply(1, 4.0)]
    packets = read_ping(lines, "x", halve=True)
    assert packets.sent == pytest.approx((0.98, 1.98, 2.98, 3.98))
    assert packets.lost == 0


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=40 ms", "run ping with -D"),
        ("PING 192.0.2.1 (192.0.2.1) 56(84) bytes of data.", "has no replies"),
    ],
)
def test_a_ping_that_cannot_be_used_is_refused(text: str, says: str) -> None:
    assert is_ping([text])
    with pytest.raises(BadInputError, match=says):
        read_ping([text], "x", halve=True)


def test_forged_numbers_of_ping_fill_no_memory() -> None:
    with pytest.raises(BadInputError, match="span 999999999999 packets"):
        read_ping([reply(1, 1.0), reply(999_999_999_999, 2.0)], "x", halve=True)


def trip(number: int, lost: Any = False, send: int = 30, receive: int = 20) -> dict[str, Any]:
    """Make a round trip as irtt 0.9 writes it; delays in [ms], one packet every 10 ms."""
    sent = 1_700_000_000_000_000_000 + number * 10_000_000
    send, receive = send * 1_000_000, receive * 1_000_000
    if lost:
        stamps: dict[str, Any] = {"client": {"receive": {}, "send": {"wall": sent}}}
        stamps["server"] = {"receive": {}, "send": {}}
        return {"seqno": number, "lost": lost, "timestamps": stamps, "delay": {}, "ipdv": {}}
    client = {"send": {"wall": sent}, "receive": {"wall": sent + send + receive}}
    server = {"receive": {"wall": sent + send}, "send": {"wall": sent + send}}
    delay = {"send": send, "receive": receive, "rtt": send + receive}
    return {
        "seqno": number,
        "lost": False,
        "timestamps": {"client": client, "server": server},
        "delay": delay,
    }


IRTT = json.dumps(
    {"round_trips": [trip(0), trip(1, "true_up"), trip(2, "true_down"), trip(3, True), trip(4)]}
)


@pytest.mark.parametrize(
    ("direction", "sent", "delays"),
    [
        ("uplink", (0.0, 0.010, 0.030, 0.040), (0.030, None, None, 0.030)),
        ("downlink", (0.0, 0.020, 0.030, 0.040), (0.020, None, None, 0.020)),
    ],
)
def test_irtt_knows_both_ways(
    direction: Direction, sent: tuple[float, ...], delays: tuple[float | None, ...]
) -> None:
    """Packets lost on the uplink were never on the downlink, and vice versa."""
    packets = read_irtt(IRTT, "x", direction, halve=False)
    assert packets.sent == pytest.approx(sent)
    assert packets.delays == pytest.approx(delays)


def test_irtt_gives_halves_if_asked() -> None:
    packets = read_irtt(IRTT, "x", "uplink", halve=True)
    assert packets.delays == pytest.approx((0.025, None, None, None, 0.025))


def test_irtt_without_stamps_of_the_server_has_round_trips_alone() -> None:
    one = trip(0)
    del one["delay"]["send"]
    with pytest.raises(BadInputError, match=r"server sent no stamps.*--halve-rtt"):
        read_irtt(json.dumps({"round_trips": [one]}), "x", "uplink", halve=False)


def test_clocks_that_differ_are_noticed() -> None:
    text = json.dumps({"round_trips": [trip(0, send=-5, receive=60)]})
    with pytest.raises(BadInputError, match="the two clocks differ"):
        read_irtt(text, "x", "uplink", halve=False)


ENDLESS = {"lost": "false", "timestamps": {"client": {"send": {"wall": float("inf")}}}}


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "{}",
        '{"round_trips": [{}]}',
        '{"round_trips": 3}',
        "[]",
        "[" * 100_000,
        json.dumps({"round_trips": [ENDLESS]}),
    ],
)
def test_other_json_is_refused(text: str) -> None:
    with pytest.raises(BadInputError, match="not a log of irtt"):
        read_irtt(text, "x", "uplink", halve=False)
