"""Logs of ping and its relatives: replies, losses, totals, sessions, clocks."""

from __future__ import annotations

import pytest

from cloudrc.errors import BadInputError
from cloudrc.link.logs import Packets, is_ping, read_ping

HEAD = "PING 192.0.2.1 (192.0.2.1) 56(84) bytes of data."


def reply(number: int, stamp: float, time: str = "20.0", end: str = "") -> str:
    return f"[{stamp:.6f}] 64 bytes from 192.0.2.1: icmp_seq={number} ttl=57 time={time} ms{end}"


def summary(sent: int, received: int) -> str:
    return f"{sent} packets transmitted, {received} received, 40% packet loss, time 800ms"


def read(*lines: str) -> Packets:
    assert is_ping(list(lines))
    return read_ping(list(lines), "x", halve=True)


PING = (
    HEAD,
    "[100.040000] 64 bytes from 192.0.2.1: icmp_seq=1 ttl=57 time=40.0 ms",
    "[100.230000] 64 bytes from host.example (192.0.2.1): icmp_seq=2 ttl=57 time=30 ms",
    "[100.410000] no answer yet for icmp_seq=3",
    "[100.700000] 64 bytes from 192.0.2.1: icmp_seq=4 ttl=57 time=100 ms",
    "[100.710000] 64 bytes from 192.0.2.1: icmp_seq=4 ttl=57 time=110 ms (DUP!)",
    "[100.900000] no answer yet for icmp_seq=5",
)
END = (
    "--- 192.0.2.1 ping statistics ---",
    "6 packets transmitted, 3 received, +1 duplicates, 40% packet loss, time 1000ms",
    "rtt min/avg/max/mdev = 30.0/70.0/110.0/30.9 ms",
)


@pytest.mark.parametrize(("end", "lost"), [((), 2), (END, 3)])
def test_ping_gives_halves_sent_when_the_request_left(end: tuple[str, ...], lost: int) -> None:
    """A packet after the last line is known from the summary only."""
    packets = read(*PING, *end)
    assert packets.sent == pytest.approx((100.0, 100.2, 100.4, 100.6, 100.8, 101.0)[: 3 + lost])
    assert packets.delays[:5] == pytest.approx((0.020, 0.015, None, 0.050, None))
    assert packets.lost == lost
    assert packets.notes == ("1 duplicates left out",)


def test_losses_before_the_first_reply_are_counted_if_told() -> None:
    told = [f"no answer yet for icmp_seq={number}" for number in (1, 2)]
    for lines in ([*told, reply(3, 10.02)], [reply(3, 10.02), summary(3, 1)]):
        packets = read(HEAD, *lines)
        assert packets.delays == (None, None, 0.010)
        assert packets.sent == pytest.approx((8.0, 9.0, 10.0))
    assert len(read(HEAD, reply(75, 10.02), reply(76, 11.02)).sent) == 2


STAMPED = "[1700000000.5] "


@pytest.mark.parametrize(
    ("lines", "delays"),
    [
        ([f"{STAMPED}64 Bytes von 192.0.2.7: icmp_seq=1 ttl=53 Zeit=20 ms"], (10,)),
        ([f"{STAMPED}64 octets de 192.0.2.7 : icmp_seq=1 ttl=53 temps=20,1 ms"], (10.05,)),
        ([f"{STAMPED}64 字节, 来自 192.0.2.7: icmp_seq=1 ttl=53 时间=20.1 毫秒"], (10.05,)),
        ([f"{STAMPED}64 bytes from ::1, icmp_seq=0 hlim=64 time=2 ms", summary(2, 1)], (1, None)),
        (
            [
                "PING h (192.0.2.7): 56 data bytes",
                "23:59:59.123456 64 bytes from 192.0.2.7: icmp_seq=0 ttl=53 time=20.5 ms",
                "Request timeout for icmp_seq 1",
                "00:00:01.123456 64 bytes from 192.0.2.7: icmp_seq=2 ttl=53 time=20.5 ms",
                "3 packets transmitted, 2 packets received, 33.3% packet loss",
                "round-trip min/avg/max/stddev = 20.5/20.5/20.5/0.0 ms",
            ],
            (10.25, None, 10.25),
        ),
        (
            [
                f"{STAMPED}192.0.2.7 : [0], 64 bytes, 20.1 ms (20.1 avg, 0% loss)",
                "[1700000001.5] 192.0.2.7 : [1], timed out (20.1 avg, 50% loss)",
                "192.0.2.7 : xmt/rcv/%loss = 2/1/50%, min/avg/max = 20.1/20.1/20.1",
            ],
            (10.05, None),
        ),
        (
            [
                "1700000000.500000 64 bytes from 192.0.2.7: seq=0 ttl=53 time=20.000 ms",
                "From 192.0.2.9 icmp_seq=1 Destination Host Unreachable",
                "2024-01-20T10:00:00.5 ping: sendmsg: Network is unreachable",
            ],
            (10, None),
        ),
    ],
)
def test_other_pings_and_languages_are_read(
    lines: list[str], delays: tuple[float | None, ...]
) -> None:
    found = [delay and delay * 1e3 for delay in read(*lines).delays]
    assert found == pytest.approx(list(delays))


def test_ping_counts_on_after_65535() -> None:
    """A late reply from before the wrap keeps its place."""
    packets = read(reply(65534, 1.0), reply(0, 3.0), reply(65535, 2.0), reply(1, 4.0))
    assert packets.sent == pytest.approx((0.98, 1.98, 2.98, 3.98))
    assert packets.lost == 0
    assert packets.notes == ("1 out of order, sorted",)


FIVE = [reply(number, number / 5) for number in range(1, 6)]


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([reply(1, 1.0)[11:]], "its lines have no .time.; run ping with -D"),
        (["64 bytes from 192.0.2.1: seq=0 ttl=57 time=40 ms"], "BusyBox's ping gives no times"),
        (["PING h (1.2.3.4): 56 data bytes", reply(0, 1.0)[11:]], "on macOS -D forbids .*apple-t"),
        (["192.0.2.7 : [0], 64 bytes, 20.1 ms (20.1 avg, 0% loss)"], "run fping with -D"),
        ([HEAD], "has no replies"),
        (["[1.0] 64 bytes from h: icmp_seq=1 ttl=57 tid=1 xx"], "cannot? ?be read|LC_ALL=C"),
        ([*FIVE, summary(5, 4)], "summary counts 5 sent and 4 received, but it has 5 replies"),
        ([*FIVE, summary(4, 5)], "summary counts 4 sent"),
        ([*FIVE[:2], summary(5, 5)], "summary counts 5 sent and 5 received, but it has 2 replies"),
        ([*FIVE, "rtt min/avg/max/mdev = 9/30/90/1 ms"], "gives a mean of 30 ms, but .* 20 ms"),
        ([HEAD, *FIVE, HEAD], "more than one session of ping .2 beginnings"),
        ([*FIVE, reply(1, 900.0)], "more than one session of ping .number 1 comes twice"),
        ([*FIVE[:2], *FIVE[3:], reply(3, 900.0)], "after number 3 the times go back by 899 s"),
        ([*FIVE, reply(6, 0.3)], "after number 5 the times go back"),
        ([reply(1, 1.0), reply(999_999_999_999, 2.0)], "span 999999999999 packets"),
    ],
)
def test_a_ping_that_cannot_be_used_is_refused(lines: list[str], says: str) -> None:
    with pytest.raises(BadInputError, match=f"^x: [^\\n]*(?:{says})"):
        read(*lines)


def test_a_step_of_the_clock_or_a_pause_is_named() -> None:
    packets = read(*FIVE, *(reply(number, 3600 + number / 5) for number in range(6, 9)))
    assert packets.notes[0] == "after number 5 the clock stepped by 3600 s, or ping stood still"
    assert len(packets.sent) == 8


def test_ping_is_not_halved_unasked() -> None:
    with pytest.raises(BadInputError, match=r"ping measures round trips; .*--halve-rtt"):
        read_ping(list(PING), "x", halve=False)
