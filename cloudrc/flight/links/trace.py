# SPDX-License-Identifier: Apache-2.0

"""Read measured delays of a link from a run, an MCAP file, a log of ping or irtt, or a CSV file.

The content of the source tells its format.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from math import inf, isnan, nan
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from cloudrc.base.files import at_place
from cloudrc.base.outside.paths import check_there
from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.tables import read_lines
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.base.requirements import require
from cloudrc.link.streams import numbers
from cloudrc.link.trace_logs import (
    Direction,
    Entry,
    Packets,
    is_ping,
    packets_of,
    read_csv,
    read_irtt,
    read_ping,
    trace_of,
)
from cloudrc.link.traces import write_trace

if TYPE_CHECKING:
    from cloudrc.results.record.columns import Recording, Table


def read_packets(
    source: Path, only: Direction | None = None, *, halve: bool = False
) -> dict[Direction, Packets]:
    """Read the delays in a source; return direction -> packets.

    `only` is the direction to take, `halve` takes half of each round trip.
    """
    check_there(source, "name a run, a log or a CSV file")
    with naming(str(source)):
        if source.is_dir() or _is_mcap(source):
            return _read_run(source, ("uplink", "downlink") if only is None else (only,), halve)
        return {only or "uplink": _read_log(source, only, halve)}


def _read_log(source: Path, direction: Direction | None, halve: bool) -> Packets:
    lines = read_lines(source, str(source), "give a run, a log of ping or irtt, or a CSV file")
    if lines and lines[0].lstrip().startswith(("{", "[{")):
        return read_irtt("\n".join(lines), direction, halve=halve)
    if is_ping(lines):
        return read_ping(lines, halve=halve)
    return read_csv(lines, str(source), halve=halve)


def _is_mcap(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(8) == b"\x89MCAP0\r\n"


def _read_run(path: Path, ways: tuple[Direction, ...], halve: bool) -> dict[Direction, Packets]:
    if halve:
        raise InvalidValueError("a run has one-way delays; leave out --halve-rtt")
    require("a trace of a run", ("record",))
    from cloudrc.results.record.holes import SOMEWHERE
    from cloudrc.results.report.folder import open_recording

    _, recording = open_recording(path)
    if SOMEWHERE in recording.holes:
        raise InvalidValueError(
            f"{recording.note}: nobody knows when, so what the link has lost is not known; give "
            "the original file"
        )
    return {way: one_way(recording, way) for way in ways}


def one_way(recording: Recording, direction: Direction) -> Packets:
    """Compute one-way delays by matching the records of sent and of arrived datagrams.

    If a datagram arrived twice, the shorter delay counts. Raise an InvalidValueError if the
    recording lacks the delays.
    """
    from cloudrc.results.metrics.link import SENT, transit_ns
    from cloudrc.results.record.holes import describe

    def seconds(stamp_ns: float) -> float:
        return (stamp_ns - rows[0][0]) * 1e-9

    sent_topic, topic = SENT[direction], f"/{direction}_delay"
    sent, arrivals = recording[sent_topic], recording[topic]
    if not len(sent) or not len(arrivals):
        raise InvalidValueError(f"no rows on {sent_topic} or {topic}, so no {direction}")
    delays = dict[tuple[float, float], float]()
    for epoch, counter, delay in _columns(arrivals, "epoch", "counter", "delay"):
        if isnan(delay):
            raise InvalidValueError(
                "its ends did not share a clock, so one-way delays are not known; record a run in "
                "local mode, or measure with irtt"
            )
        delays[epoch, counter] = min(delay, delays.get((epoch, counter), inf))
    rows = list(_columns(sent, "stamp_ns", "epoch", "counter"))
    longest_ns = transit_ns(recording, direction)
    holes = recording.holes
    known = [row for row in rows if not any(h.meets(row[0], row[0] + longest_ns) for h in holes)]
    why = f"left out, because their arrivals may be lost: {describe(holes, seconds)}"
    counts = Counter({why: len(rows) - len(known)})
    # The link did not lose what arrived before the receiver's session was open, and what may
    # still arrive after the end. All datagrams of these times are left out, also those that
    # arrived: if they alone remained, the trace would lose too few.
    latest_first = reversed(list(_columns(arrivals, "epoch", "counter")))
    first = {epoch: counter for epoch, counter in latest_first}  # the first arrival remains
    entries = list[Entry]()
    last_ns = {epoch: stamp_ns for stamp_ns, epoch, _ in rows}
    for stamp_ns, epoch, counter in known:
        if counter >= first.get(epoch, inf) and stamp_ns < last_ns[epoch] - longest_ns:
            delay = delays.get((epoch, counter), nan)
            entries.append((seconds(stamp_ns), delay, not isnan(delay)))
    last = f"in its last {longest_ns * 1e-6:.4g} ms"
    unknown = f"left out, sent before the session was open or {last}"
    counts[unknown] = len(known) - len(entries)
    return packets_of(entries, counts)


def _columns(table: Table, *names: str) -> Iterator[tuple[float, ...]]:
    return zip(*(table[name].tolist() for name in names), strict=True)


def write_trace_file(packets: Packets, path: Path, direction: Direction) -> list[str]:
    """Write packets as a trace; describe it, and how a profile can use it, in lines."""
    with at_place(path):
        path.write_text(write_trace(trace_of(packets)), encoding="utf-8")
    found, count = numbers(packets), len(packets.delays)
    mean, deviation = found.mean * 1e3, found.deviation * 1e3
    seconds = packets.sent[-1] - packets.sent[0]
    what = "half of each round trip" if packets.halved else "one way"
    lines = [
        f"{path}: {count} packets in {seconds:.1f} s, {what} {mean:.4g} ± "
        f"{deviation:.3g} ms (mean, standard deviation), {found.loss:.3g} lost"
        + "".join(f"; {note}" for note in packets.notes),
        f"  replay:   --set link.profile=ideal --set link.{direction}.trace={quote(str(path))}",
    ]
    if deviation:
        drawn = f"{{delay_ms: {mean:.4g}, jitter_ms: {deviation:.3g}, "
        lines.append(f"  or draw:  {drawn}distribution: table, table: {path.name}}}")
    return lines
