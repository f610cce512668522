# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link record SOURCE`: turn measured delays into a trace for a profile.

The source is a run, an MCAP file, a log of ping or irtt, or a CSV file. The command detects the
format from the content of the source.
"""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.paths import check_new
from cloudrc.doors.cli.parser import Options, Parser

EPILOG = """\
sources:
  a run         its folder or mission.mcap: one-way delays of the datagrams that
                arrived, and the losses
  ping -D HOST  output of Linux' ping in English, with --halve-rtt
  irtt client -o FILE.json HOST
                with --direction, or with --halve-rtt
  a CSV file    columns time_s and delay_ms (units: _s, _ms, _us or _ns);
                rtt_ms with --halve-rtt; a loss: lost = 1, received = 0, or an
                empty delay
  FILE.up, FILE.down
                a capacity trace of mahimahi: FILE of -o becomes a profile whose
                rate_trace replays it

examples:
  cloudrc link record runs/latest -o trace.csv
  cloudrc link record ping.log --halve-rtt -o lte.csv
  cloudrc run --set link.profile=ideal --set link.uplink.trace=trace-uplink.csv

A trace describes one direction. A run has two: without --direction the command
writes both, and adds the direction to each file name."""


def arguments(parser: Parser) -> None:
    """Declare the action's arguments."""
    parser.add_argument("source", type=Path, metavar="SOURCE", help="a run, a log or a CSV file")
    parser.add_argument(
        "-o", "--output", type=Path, required=True, metavar="FILE", help="the trace to write"
    )
    parser.add_argument(
        "--direction", choices=("uplink", "downlink"), help="take this direction only"
    )
    about = "take half of each round trip of a log; correct only if both directions are equal"
    parser.add_argument("--halve-rtt", action="store_true", help=about)


def execute(options: Options) -> None:
    """Read the delays from SOURCE, write a trace per direction, and print a summary of each."""
    from cloudrc.flight.links.rates import is_capacity, write_rate_profile
    from cloudrc.flight.links.trace import read_packets, write_trace_file

    source, output = options.source, options.output
    if is_capacity(source):
        if options.halve_rtt:
            raise BadInputError(f"{source}: has no round trips; leave out --halve-rtt")
        check_new(output)
        print("\n".join(write_rate_profile(source, output, options.direction)))
        return
    found = read_packets(source, options.direction, halve=options.halve_rtt)
    paths = {
        way: output.with_stem(f"{output.stem}-{way}") if len(found) > 1 else output for way in found
    }
    for path in paths.values():
        check_new(path)
    for way, packets in found.items():
        print("\n".join(write_trace_file(packets, paths[way], way)))
