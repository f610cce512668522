"""`cloudrc link record SOURCE`: measured delays come in, a trace for a profile goes out."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.link.traces import Direction, Packets

EPILOG = """\
sources:
  a run         its folder or mission.mcap: all datagrams that arrived, one way,
                and those that did not
  ping -D HOST  its output, with --halve-rtt
  irtt client -o FILE.json HOST
                with --direction, or with --halve-rtt
  a CSV file    time_s and delay_ms, or with _s, _ms, _us or _ns at the end;
                rtt_ms with --halve-rtt; lost: 0 or 1, or an empty delay

examples:
  cloudrc link record runs/latest -o trace.csv
  cloudrc link record ping.log --halve-rtt -o lte.csv
  cloudrc run --set link.profile=ideal --set link.uplink.trace=trace-uplink.csv

A trace is one way. A run has both ways: without --direction both are written,
the direction's name added to the file's."""
DIRECTIONS: tuple[Direction, ...] = ("uplink", "downlink")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the action's arguments."""
    parser.add_argument("source", type=Path, metavar="SOURCE", help="a run, a log or a CSV file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the trace to write"
    )
    parser.add_argument("--direction", choices=DIRECTIONS, help="take one direction alone")
    parser.add_argument(
        "--halve-rtt",
        action="store_true",
        help="take half of each round trip: right only if both directions are alike",
    )
    parser.add_argument(
        "--trust-units", action="store_true", help="take values that look like another unit"
    )


def execute(options: argparse.Namespace) -> int:
    """Read the source, write the trace or traces, and say what is in them."""
    from cloudrc.cli.link_source import from_log, from_run, is_run

    source: Path = options.source
    if not (source.is_dir() or source.is_file()):
        raise BadInputError(f"{source}: no such file or folder; name a run, a log or a CSV file")
    halve: bool = options.halve_rtt
    if not is_run(source):
        packets = from_log(source, options.direction, halve=halve, trust_units=options.trust_units)
        _write(packets, options.output, options.direction or "uplink", halve=halve)
        return 0
    both = options.direction is None and not halve
    only: Direction = options.direction or "uplink"
    chosen = DIRECTIONS if both else (only,)
    read = [(name, from_run(source, name, halve=halve)) for name in chosen]
    for name, packets in read:
        file = options.output
        file = file.with_stem(f"{file.stem}-{name}") if both else file
        _write(packets, file, name, halve=halve)
    return 0


def _write(packets: Packets, path: Path, direction: str, *, halve: bool) -> None:
    """Write one trace; say what is in it and how a profile asks for it, as a replay or a table."""
    from statistics import fmean, pstdev

    from cloudrc.link.traces import trace_of, write_trace

    path.write_text(write_trace(trace_of(packets)), encoding="utf-8")
    arrived = [delay * 1e3 for delay in packets.arrived]
    mean, deviation = fmean(arrived), pstdev(arrived)
    count = len(packets.delays)
    print(
        f"{path}: {count} packets in {packets.duration:.1f} s, {'half of ' if halve else ''}"
        f"{'each round trip' if halve else 'one way'} {mean:.4g} ± {deviation:.3g} ms "
        f"(mean, standard deviation), {packets.lost / count:.3g} lost"
    )
    print(f"  replay:   --set link.profile=ideal --set link.{direction}.trace={path}")
    if deviation:
        print(f"  or draw:  {{delay_ms: {mean:.4g}, jitter_ms: {deviation:.3g}, ", end="")
        print(f"distribution: table, table: {path.name}}}")
