"""Read measured delays of a link from a run, an MCAP file, a log of ping or irtt, or a CSV file.

The content of the source tells its format.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from math import inf, isnan, nan
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

from cloudrc.files import at_place
from cloudrc.link.streams import numbers
from cloudrc.link.trace_logs import (
    Direction,
    Log,
    Packets,
    is_ping,
    read_csv,
    read_irtt,
    read_ping,
    trace_of,
)
from cloudrc.link.traces import read_lines, write_trace
from cloudrc.outside.paths import check_there
from cloudrc.runs.requirements import require

if TYPE_CHECKING:
    from cloudrc.record.columns import Recording, Table
    from cloudrc.record.holes import Hole

DIRECTIONS: tuple[Direction, ...] = ("uplink", "downlink")


@dataclass(frozen=True)
class LogSettings:
    """How to read a log; a field is the flag of this name."""

    direction: Direction | None = None  # take this direction only
    halve_rtt: bool = False  # take half of each round trip


def read_packets(source: Path, settings: LogSettings) -> dict[Direction, Packets]:
    """Read the delays in a source; return direction -> packets."""
    only = settings.direction
    check_there(source, "name a run, a log or a CSV file")
    if not _is_run(source):
        return {only or "uplink": _from_log(source, settings)}
    if settings.halve_rtt:
        raise Log(str(source)).error("a run has one-way delays; leave out --halve-rtt")
    require("a trace of a run", ("record",))
    recording = _recording(source)
    ways: tuple[Direction, ...] = (only,) if only else DIRECTIONS
    return {way: one_way(recording, source, way) for way in ways}


def _is_run(path: Path) -> bool:
    if path.is_dir():
        return True
    with path.open("rb") as file:
        return file.read(8) == b"\x89MCAP0\r\n"


def _from_log(path: Path, settings: LogSettings) -> Packets:
    name, halve = str(path), settings.halve_rtt
    remedy = "give a run, a log of ping or irtt, or a CSV file"
    lines = read_lines(path, name, remedy)
    if lines and lines[0].lstrip().startswith(("{", "[{")):
        return read_irtt("\n".join(lines), name, settings.direction, halve=halve)
    if is_ping(lines):
        return read_ping(lines, name, halve=halve)
    return read_csv(lines, name, halve=halve)


def _recording(path: Path) -> Recording:
    from cloudrc.record.columns import Recording
    from cloudrc.record.holes import SOMEWHERE
    from cloudrc.runs.session import check_ended

    file = path / "mission.mcap" if path.is_dir() else path
    check_ended(file.parent)
    check_there(file, "name the folder of a run, or a file")
    recording = Recording.read(file, whole=True)
    if SOMEWHERE in recording.holes:
        raise Log(str(file)).error(
            f"{recording.note}: nobody knows when, so what the link has lost is not known; give "
            "the original file"
        )
    return recording


def one_way(recording: Recording, path: Path, direction: Direction) -> Packets:
    """Compute one-way delays by matching the records of sent and of arrived datagrams.

    If a datagram arrived twice, the shorter delay counts. `path` is the name of the recording.
    """
    from cloudrc.metrics.link import SENT, transit_ns

    log, sent_topic, topic = Log(str(path)), SENT[direction], f"/{direction}_delay"
    sent, arrivals = recording[sent_topic], recording[topic]
    if not len(sent) or not len(arrivals):
        missing = sent_topic if not len(sent) else topic
        raise log.error(
            f"no rows on {missing}, so no {direction}; give the run's folder or its mission.mcap"
        )
    delays = _delays(arrivals, log)
    rows = list(_columns(sent, "stamp_ns", "epoch", "counter"))
    longest_ns = transit_ns(recording, direction)
    known = _outside_holes(rows, recording.holes, longest_ns, log)
    # The link did not lose what arrived before the receiver's session was open, and what may
    # still arrive after the end. All datagrams of these times are left out, also those that
    # arrived: if they alone remained, the trace would lose too few.
    latest_first = reversed(list(_columns(arrivals, "epoch", "counter")))
    first = {epoch: counter for epoch, counter in latest_first}  # the first arrival remains
    last_ns = {epoch: stamp_ns for stamp_ns, epoch, _ in rows}
    log.entries = [
        ((stamp_ns - rows[0][0]) * 1e-9, delays.get((epoch, counter), nan))
        for stamp_ns, epoch, counter in known
        if counter >= first.get(epoch, inf) and stamp_ns < last_ns[epoch] - longest_ns
    ]
    unknown = len(known) - len(log.entries)
    last = f"in its last {longest_ns * 1e-6:.4g} ms"
    log.counts[f"left out, sent before the session was open or {last}"] += unknown
    return log.packets()


def _outside_holes(
    rows: list[tuple[float, ...]], holes: Iterable[Hole], longest_ns: int, log: Log
) -> list[tuple[float, ...]]:
    """Leave out the datagrams whose arrival may be lost in a hole of the recording.

    `rows` begin with the stamp of sending [ns], and `longest_ns` is the longest time to the arrival
    [ns]. `log` notes what is left out.
    """
    from cloudrc.record.holes import describe

    def seconds(stamp_ns: float) -> float:
        return (stamp_ns - rows[0][0]) * 1e-9

    lost = [row for row in rows if any(h.meets(row[0], row[0] + longest_ns) for h in holes)]
    if lost:
        why = f"their arrivals may be lost: {describe(holes, seconds)}"
        log.counts[f"left out, because {why}"] += len(lost)
    left_out = set(lost)
    return [row for row in rows if row not in left_out]


def _delays(arrivals: Table, log: Log) -> dict[tuple[float, float], float]:
    """Return epoch and counter of each datagram that arrived -> its delay [s]."""
    delays: dict[tuple[float, float], float] = {}
    for epoch, counter, delay in _columns(arrivals, "epoch", "counter", "delay"):
        if isnan(delay):
            raise log.error(
                "its ends did not share a clock, so one-way delays are not known; record a run in "
                "local mode, or measure with irtt"
            )
        log.counts["duplicates left out"] += (epoch, counter) in delays
        delays[epoch, counter] = min(delay, delays.get((epoch, counter), delay))
    return delays


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
