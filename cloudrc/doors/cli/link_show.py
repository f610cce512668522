# SPDX-License-Identifier: Apache-2.0

"""Run `cloudrc link show`: draw a profile and print its statistics."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.base.files import at_place
from cloudrc.base.outside.paths import check_picture
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import tell
from cloudrc.doors.cli.parser import (
    Options,
    Parser,
    number,
    read_seed,
    settings_from,
    whole_number,
)

PACKETS_MAX = 10_000_000  # in one direction
EPILOG = """\
examples:
  cloudrc link show lossy
  cloudrc link show my.yaml --seconds 120 -o my.svg
  cloudrc link show trace.csv
  cloudrc link show ./my.yaml --packets 300000 --rate 200

The delays come from the same link model as in a flight, packet by packet: a
flight with the same seed has exactly these delays. All delays are one way.
A trace has one packet per row, whatever the duration of the row; a short trace
with losses between 0 and 1 has several."""


def arguments(parser: Parser) -> None:
    """Declare the arguments."""
    parser.add_argument(
        "profile", metavar="PROFILE", help="shipped profile, a file, or a trace in CSV"
    )
    about = "the picture: .png, .svg or .pdf (default: NAME.png)"
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", help=about)
    about = "time to show (default: 30, or the whole schedule)"
    parser.add_argument("--seconds", type=number(0.001, 86_400, "seconds"), metavar="S", help=about)
    about = "seed of the random draws (default: 1)"
    parser.add_argument("--seed", type=read_seed, default=1, metavar="S", help=about)
    about = "packets per second (default: 100)"
    parser.add_argument(
        "--rate", type=number(1, 10_000, "Hz"), default=100.0, metavar="HZ", help=about
    )
    about = "packets for the statistics of an unchanging link (default: 100000)"
    parser.add_argument(
        "--packets", type=whole_number(1, PACKETS_MAX), default=100_000, metavar="N", help=about
    )


def execute(options: Options) -> None:
    """Write a picture of a profile; print statistics and, in the last line, the file's path."""
    output = options.output or Path(f"{Path(options.profile).stem}.png")
    check_picture(output, "-o")
    if (options.seconds or 0.0) * options.rate > PACKETS_MAX:
        text = f"are more than {PACKETS_MAX} packets; give less with --seconds or --rate"
        raise BadInputError(f"--seconds {options.seconds:g} at --rate {options.rate:g} {text}")
    from cloudrc.doors.cli.progress import Progress

    with Progress(f"draws {options.profile}"):
        title, text, picture = _drawn(options, output.suffix[1:])
    with at_place(output):
        output.write_bytes(picture)
    print(title, text, escape(str(output)), sep="\n")


def _drawn(options: Options, kind: str) -> tuple[str, str, bytes]:
    """Return title, statistics and picture of a profile."""
    from cloudrc.flight.links.sample import SampleSettings, sample_profile, statistics_table
    from cloudrc.results.report.figures.link import render_link

    settings = settings_from(options, SampleSettings)
    about, ways = sample_profile(options.profile, settings, tell)
    title = escape(": ".join(filter(None, (Path(options.profile).stem, about))))
    picture = render_link(title, [sample for sample, _ in ways.values()], kind)
    text = statistics_table(ways)
    return title, text, picture
