"""Run `cloudrc link record SOURCE`: turn measured delays into a trace for a profile.

The source is a run, an MCAP file, a log of ping or irtt, or a CSV file. The command detects the
format from the content of the source.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.output import refuse_other_file
from cloudrc.errors import BadInputError
from cloudrc.files import naming
from cloudrc.runs.requirements import require

if TYPE_CHECKING:
    from cloudrc.link.logs import Direction, Packets
    from cloudrc.record.columns import Recording, Table

EPILOG = """\
sources:
  a run         its folder or mission.mcap: one-way delays of the datagrams that
                arrived, and the losses
  ping -D HOST  its output, with --halve-rtt
  irtt client -o FILE.json HOST
                with --direction, or with --halve-rtt
  a CSV file    columns time_s and delay_ms (units: _s, _ms, _us or _ns);
                rtt_ms with --halve-rtt; a loss: lost = 1, or an empty delay

examples:
  cloudrc link record runs/latest -o trace.csv
  cloudrc link record ping.log --halve-rtt -o lte.csv
  cloudrc run --set link.profile=ideal --set link.uplink.trace=trace-uplink.csv

A trace describes one direction. A run has two: without --direction the command
writes both, and adds the direction to each file name."""
DIRECTIONS: tuple[Direction, ...] = ("uplink", "downlink")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the action's arguments."""
    add = parser.add_argument
    add("source", type=Path, metavar="SOURCE", help="a run, a log or a CSV file")
    add("-o", "--output", type=Path, required=True, metavar="FILE", help="the trace to write")
    add("--direction", choices=DIRECTIONS, help="take this direction only")
    halve = "take half of each round trip of a log; correct only if both directions are equal"
    add("--halve-rtt", action="store_true", help=halve)
    trust = "accept values that look as if they had another unit"
    add("--trust-units", action="store_true", help=trust)


def execute(options: argparse.Namespace) -> int:
    """Read the delays from SOURCE, write a trace per direction, and print a summary of each."""
    from cloudrc.link.traces import HEAD

    source, output, only = options.source, options.output, options.direction
    if not (source.is_dir() or source.is_file()):
        raise BadInputError(f"{source}: no such file or folder; name a run, a log or a CSV file")
    if not _is_run(source):
        found = {only or "uplink": _from_log(source, options)}
    else:
        if options.halve_rtt:
            raise BadInputError(f"{source}: a run has one-way delays; leave out --halve-rtt")
        require("a trace of a run", ("record",))
        recording = _recording(source)
        ways = (only,) if only else DIRECTIONS
        found = {way: one_way(recording, source, way) for way in ways}
    paths = {
        way: output.with_stem(f"{output.stem}-{way}") if len(found) > 1 else output for way in found
    }
    for path in paths.values():
        refuse_other_file(path, HEAD, source)
    for way, packets in found.items():
        _write(packets, paths[way], way)
    return 0


def _write(packets: Packets, path: Path, direction: str) -> None:
    from cloudrc.link.logs import trace_of
    from cloudrc.link.model import numbers
    from cloudrc.link.traces import write_trace

    with naming(path):
        path.write_text(write_trace(trace_of(packets)), encoding="utf-8")
    found, count = numbers(packets), len(packets.delays)
    mean, deviation = found.mean * 1e3, found.deviation * 1e3
    seconds = packets.sent[-1] - packets.sent[0]
    what = "half of each round trip" if packets.halved else "one way"
    print(
        f"{path}: {count} packets in {seconds:.1f} s, {what} {mean:.4g} ± "
        f"{deviation:.3g} ms (mean, standard deviation), {found.loss:.3g} lost"
        + "".join(f"; {note}" for note in packets.notes)
    )
    print(f"  replay:   --set link.profile=ideal --set link.{direction}.trace={path}")
    if deviation:
        print(f"  or draw:  {{delay_ms: {mean:.4g}, jitter_ms: {deviation:.3g}, ", end="")
        print(f"distribution: table, table: {path.name}}}")


def _is_run(path: Path) -> bool:
    if path.is_dir():
        return True
    with path.open("rb") as file:
        return file.read(8) == b"\x89MCAP0\r\n"


def _from_log(path: Path, options: argparse.Namespace) -> Packets:
    from cloudrc.link.logs import is_ping, read_csv, read_irtt, read_ping, refuse_others
    from cloudrc.link.traces import read_lines

    name, halve = str(path), options.halve_rtt
    remedy = "give a run, a log of ping or irtt, or a CSV file"
    lines = read_lines(path, name, remedy)
    refuse_others(lines, name)
    if lines and lines[0].lstrip().startswith(("{", "[{")):
        return read_irtt("\n".join(lines), name, options.direction, halve=halve)
    if is_ping(lines):
        return read_ping(lines, name, halve=halve)
    return read_csv(lines, name, halve=halve, trust_units=options.trust_units)


def _recording(path: Path) -> Recording:
    from cloudrc.record.columns import Recording

    file = path / "mission.mcap" if path.is_dir() else path
    if not file.is_file():
        raise BadInputError(f"{path}: has no mission.mcap; name the folder of a run, or a file")
    return Recording.read(file)


def one_way(recording: Recording, path: Path, direction: Direction) -> Packets:
    """Compute one-way delays by matching the records of sent and of arrived datagrams.

    If a datagram arrived twice, the shorter delay counts. Raise a BadInputError that names `path`
    if the recording has no one-way delays.
    """
    from cloudrc.link.logs import Log
    from cloudrc.metrics.link import SENT, SETTLING_NS

    log, sent_topic, topic = Log(str(path)), SENT[direction], f"/{direction}_delay"
    sent, arrivals = recording[sent_topic], recording[topic]
    if not len(sent) or not len(arrivals):
        missing = sent_topic if not len(sent) else topic
        raise log.error(
            f"no rows on {missing}, so no {direction}; give the run's folder or its mission.mcap"
        )
    delays: dict[tuple[float, float], float] = {}
    for epoch, counter, delay in _columns(arrivals, "epoch", "counter", "delay"):
        if isnan(delay):
            raise log.error(
                "its ends did not share a clock, so one-way delays are not known; record a run in "
                "local mode, or measure with irtt"
            )
        log.counts["duplicates left out"] += (epoch, counter) in delays
        delays[epoch, counter] = min(delay, delays.get((epoch, counter), delay))
    rows = list(_columns(sent, "stamp_ns", "epoch", "counter"))
    # The receiver may refuse datagrams sent before its session opened or near the session's end.
    # The link did not lose these datagrams: leave them out.
    latest_first = reversed(list(_columns(arrivals, "epoch", "stamp_ns")))
    opened_ns = {epoch: stamp_ns for epoch, stamp_ns in latest_first}  # the first arrival remains
    last_ns = {epoch: stamp_ns for stamp_ns, epoch, _ in rows}
    log.entries = [
        ((stamp_ns - rows[0][0]) * 1e-9, delays.get((epoch, counter), nan))
        for stamp_ns, epoch, counter in rows
        if (epoch, counter) in delays
        or opened_ns.get(epoch, stamp_ns) < stamp_ns <= last_ns[epoch] - SETTLING_NS
    ]
    unknown = len(rows) - len(log.entries)
    log.counts["left out, sent before the session was open or in its last 2 s"] += unknown
    return log.packets()


def _columns(table: Table, *names: str) -> Iterator[tuple[float, ...]]:
    return zip(*(table[name].tolist() for name in names), strict=True)
