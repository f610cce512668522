"""Logs of ping and irtt: their lines or JSON go in, packets come out.

    ping -D -i 0.2 -O HOST > ping.log
    irtt client -i 10ms -l 203 -d 1m -o irtt.json HOST

203 bytes are a datagram of telemetry; of commands, 88. ping knows round trips alone. irtt knows
both ways if the clocks of both hosts agree.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator
from statistics import median
from typing import Any, Literal, TypeAlias

from cloudrc.errors import BadInputError
from cloudrc.link.trace_packets import Packets, in_order

Direction: TypeAlias = Literal["uplink", "downlink"]

_STAMP = re.compile(r"\[(\d+(?:\.\d+)?)\] ")
_REPLY = re.compile(r"icmp_seq=(\d{1,12}) .*\btime[=<](\d+(?:\.\d+)?) ms")
_WRAP = 1 << 16
_PACKETS_MAX = 10_000_000
"""More than ping sends in three weeks at five a second; forged numbers would fill the memory."""
_MISSHAPEN = ArithmeticError, AttributeError, LookupError, RecursionError, TypeError, ValueError
"""What JSON of any other shape raises."""
_HALVE = (
    "a trace is one way; if both directions are alike, take half of each round trip with "
    "--halve-rtt, else measure one way with irtt between synchronised clocks"
)


class _NoStampsError(Exception):
    """A log of irtt without one-way delays."""


def is_ping(lines: Iterable[str]) -> bool:
    """Say whether a text looks like the output of ping."""
    return any("icmp_seq=" in line or line.startswith("PING ") for line in lines)


def read_ping(lines: Iterable[str], name: str, *, halve: bool) -> Packets:
    """Read what `ping -D` printed.

    A reply is stamped when it arrived. Sequence numbers without a reply are lost packets, those
    after the last reply excepted: they may have been under way. Source: ping(8) of iputils.

    Args:
        lines: Of the log; what is no reply is skipped.
        name: Of the file, for messages.
        halve: Whether to take half of each round trip; it is refused else.

    Returns:
        Packets, half a round trip each.

    Raises:
        BadInputError: If there are no replies or no stamps, or too many packets between the first
            and the last, or if `halve` is not set.
    """
    if not halve:
        raise BadInputError(f"{name}: ping measures round trips; {_HALVE}")
    replies = dict(_replies(lines, name))
    if not replies:
        raise BadInputError(f"{name}: no replies in it; give the output of: ping -D HOST")
    first, last = min(replies), max(replies)
    if last - first >= _PACKETS_MAX:
        raise BadInputError(
            f"{name}: its numbers span {last - first + 1} packets, more than {_PACKETS_MAX}; "
            "give the output of one ping"
        )
    period = (replies[last][0] - replies[first][0]) / max(last - first, 1)
    entries: list[tuple[float, float | None]] = []
    sent = replies[first][0] - period
    for number in range(first, last + 1):
        if number in replies:
            sent, round_trip = replies[number]
            entries.append((sent, round_trip / 2))
        else:
            sent += period
            entries.append((sent, None))
    return in_order(entries, name)


def _replies(lines: Iterable[str], name: str) -> Iterator[tuple[int, tuple[float, float]]]:
    """Find each reply's number, counted on where ping begins anew, its instant and round trip."""
    turns, newest = 0, 0
    seen = set()
    for line in lines:
        reply = _REPLY.search(line)
        if reply is None or "DUP!" in line:
            continue
        stamp = _STAMP.match(line)
        if stamp is None:
            raise BadInputError(f"{name}: its lines have no [time]; run ping with -D")
        # ping counts to 65535 and on from 0; what comes late may be of the turn before.
        number = int(reply[1]) + turns * _WRAP
        if newest - number > _WRAP // 2:
            turns, number = turns + 1, number + _WRAP
        elif number - newest > _WRAP // 2 and turns:
            number -= _WRAP
        newest = max(newest, number)
        if number not in seen:
            seen.add(number)
            round_trip = float(reply[2]) * 1e-3
            yield number, (float(stamp[1]) - round_trip, round_trip)


def read_irtt(text: str, name: str, direction: Direction, *, halve: bool) -> Packets:
    """Read what `irtt client -o FILE.json` wrote.

    The client is taken for the robot: what it sends is the uplink. A packet of which irtt says
    only that it is lost, not which way, counts as lost in both.

    Source: irtt-client(1), JSON format 1.

    Args:
        text: Of the file.
        name: Of the file, for messages.
        direction: Which of the two to take.
        halve: Whether to take half of each round trip in place of the one-way delay.

    Raises:
        BadInputError: If it is no such file, or if it has no one-way delays and `halve` is not set.
    """
    try:
        trips = json.loads(text)["round_trips"]
        if halve:
            entries = [(_sent(trip), _delay(trip, "rtt")) for trip in trips]
        else:
            entries = _one_way(trips, direction)
        start, half = min(sent for sent, _ in entries), 0.5 if halve else 1.0
        return in_order(
            (
                ((sent - start) * 1e-9, None if delay is None else delay * half * 1e-9)
                for sent, delay in entries
            ),
            name,
        )
    except _NoStampsError:
        raise refusal(f"{name} (irtt's server sent no stamps)") from None
    except _MISSHAPEN as error:
        raise BadInputError(
            f"{name}: not a log of irtt ({type(error).__name__}: {error}); "
            "give the file that 'irtt client -o FILE.json' writes"
        ) from None


def _one_way(trips: list[dict[str, Any]], direction: Direction) -> list[tuple[int, int | None]]:
    """Read one direction: when each packet left and its delay [ns].

    What was lost in the other direction is left out: the downlink never saw it, or how late it was
    on the uplink is not known. When a packet that was lost on its way down had left is taken from
    the middle of the uplink's delays.
    """
    if direction == "uplink":
        kept = [trip for trip in trips if _lost(trip) != "true_down"]
        return [(_sent(trip), _delay(trip, "send")) for trip in kept]
    up = median([_delay(trip, "send") or 0 for trip in trips if _lost(trip) == "false"] or [0])
    entries: list[tuple[int, int | None]] = []
    for trip in trips:
        delay = _delay(trip, "receive")
        if delay is not None:
            entries.append((int(trip["timestamps"]["client"]["receive"]["wall"]) - delay, delay))
        elif _lost(trip) != "true_up":
            entries.append((_sent(trip) + round(up), None))
    return entries


def _sent(trip: dict[str, Any]) -> int:
    return int(trip["timestamps"]["client"]["send"]["wall"])


def _lost(trip: dict[str, Any]) -> str:
    return str(trip["lost"]).lower()


def _delay(trip: dict[str, Any], key: str) -> int | None:
    """Look a delay up [ns]; None if the packet was lost."""
    if _lost(trip) != "false":
        return None
    if key not in trip["delay"]:
        raise _NoStampsError
    return int(trip["delay"][key])


def refusal(name: str) -> BadInputError:
    """Say that a source has round trips alone."""
    return BadInputError(f"{name}: has round trips; {_HALVE}")
