"""Run `cloudrc link show PROFILE`: draw a profile and print its statistics."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.extras import require
from cloudrc.cli.output import escape, print_line, table
from cloudrc.errors import BadInputError

if TYPE_CHECKING:
    from cloudrc.config.schema import Direction, Profile
    from cloudrc.link.model import Numbers, Stream
    from cloudrc.link.profile import DirectionProfile, Trace
    from cloudrc.report.figures.link import DirectionSample

EPILOG = """\
examples:
  cloudrc link show lossy
  cloudrc link show my.yaml --seconds 120 -o my.svg
  cloudrc link show trace.csv
  cloudrc link show ./my.yaml --packets 300000 --rate 200

The delays come from the same link model as in a flight, packet by packet: a
flight with the same seed has exactly these delays. All delays are one way.
Of a trace every row counts the same, however long it holds."""
RATE_HZ = 100.0
"""Default rate of packets [1/s]."""
DIRECTIONS = ("uplink", "downlink")
DEFAULT_PACKETS = 100_000
"""Default number of packets for the statistics of a link that does not change."""
PACKETS_MAX, RATE_MAX = 10_000_000, 10_000.0
ROWS = 1000
"""Least number of packets for the picture of a trace. If the trace has fewer rows, each row gets
several packets."""
SECONDS = 30.0
"""Default time that the picture shows [s]; longer if the profile's time line is longer."""
KINDS = ("png", "svg", "pdf")


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the action's arguments."""
    parser.add_argument(
        "profile", metavar="PROFILE", help="shipped profile, a file, or a trace in CSV"
    )
    parser.add_argument(
        "-o",
        "--output",
        type=Path,
        metavar="FILE",
        help="the picture: .png, .svg or .pdf (default: NAME.png)",
    )
    parser.add_argument(
        "--seconds",
        type=float,
        metavar="S",
        help="time to show (default: 30, or the whole time line)",
    )
    parser.add_argument(
        "--seed", type=int, default=1, metavar="S", help="seed of the random draws (default: 1)"
    )
    parser.add_argument(
        "--rate",
        type=float,
        default=RATE_HZ,
        metavar="HZ",
        help="packets per second (default: 100)",
    )
    parser.add_argument(
        "--packets",
        type=int,
        default=DEFAULT_PACKETS,
        metavar="N",
        help=f"packets for the statistics of an unchanging link (default: {DEFAULT_PACKETS})",
    )


def execute(options: argparse.Namespace) -> int:
    """Draw the profile and print its statistics; the last line is the picture's path."""
    require("a picture of a link", ("report",))
    output = options.output or Path(f"{Path(options.profile).stem}.png")
    if output.suffix[1:] not in KINDS:
        raise BadInputError(f"-o {output}: not a picture; end its name in .png, .svg or .pdf")
    _check(options)
    from cloudrc.report.figures.link import render_link

    profile = _profile(options.profile)
    ways: dict[str, DirectionSample] = {}
    counted: dict[str, Numbers] = {}
    for name in ("uplink",) if _is_trace(options.profile) else DIRECTIONS:
        ways[name], counted[name] = _way(getattr(profile, name), name, options)
    title = escape(": ".join(filter(None, (Path(options.profile).stem, profile.description))))
    output.write_bytes(render_link(title, ways["uplink"], ways.get("downlink"), output.suffix[1:]))
    print(title)
    print(_table(counted))
    print_line(str(output))
    return 0


def _check(options: argparse.Namespace) -> None:
    """Refuse option values outside their range."""
    if options.seconds is not None and not 0.0 < options.seconds <= 86_400.0:
        raise BadInputError(f"--seconds {options.seconds:g}: give a number above 0, at most 86400")
    if options.seed < 0:
        raise BadInputError(f"--seed {options.seed}: give a whole number that is not negative")
    if not 1.0 <= options.rate <= RATE_MAX:
        raise BadInputError(f"--rate {options.rate:g}: give a number from 1 to {RATE_MAX:g}")
    if not 1 <= options.packets <= PACKETS_MAX:
        raise BadInputError(f"--packets {options.packets}: give a number from 1 to {PACKETS_MAX}")


def _is_trace(name: str) -> bool:
    return name.endswith(".csv")


def _profile(name: str) -> Profile:
    from cloudrc.config.load import load_profile
    from cloudrc.config.schema import Direction, Profile
    from cloudrc.link.traces import read_trace

    if _is_trace(name):
        path = Path(name).absolute()
        times = read_trace(path).times
        about = f"a trace of {len(times)} rows in {times[-1] - times[0]:.4g} s"
        return Profile(description=about, uplink=Direction(trace=str(path)))
    return load_profile(name)


def _way(
    asked: Direction, name: str, options: argparse.Namespace
) -> tuple[DirectionSample, Numbers]:
    """Simulate one direction.

    If the link does not change over time, the statistics come from a longer stream than the
    picture.
    """
    from cloudrc.assembly import link_profile
    from cloudrc.link.model import numbers
    from cloudrc.link.profile import Timeline
    from cloudrc.report.figures.link import DirectionSample

    profile = link_profile(asked)
    timeline = Timeline(profile)
    seed, rate = options.seed, options.rate
    if profile.trace is not None and options.seconds is None:
        shown = _rows(profile, profile.trace, name, seed)
    else:
        seconds = options.seconds or max(SECONDS, 1.1e-9 * timeline.last_ns)
        if seconds * rate > PACKETS_MAX:
            raise BadInputError(
                f"{seconds:g} s at {rate:g} packets a second are more than {PACKETS_MAX} packets; "
                "give less with --seconds or --rate"
            )
        shown = stream(profile, name, seed, round(seconds * rate), rate)
    many = shown
    if timeline.only() is not None:
        many = stream(profile, name, seed, options.packets, rate)
    counted = numbers(many)
    return DirectionSample(asked, shown.sent, shown.delays, many.delays, counted.runs), counted


def stream(
    profile: DirectionProfile, name: str, seed: int, count: int, rate: float = RATE_HZ
) -> Stream:
    """Simulate packets in one direction, with the kind and size of a flight's datagrams.

    Args:
        profile: Conditions of the link.
        name: "uplink" or "downlink".
        seed: Seed of the experiment.
        count: Number of packets.
        rate: Rate of packets [1/s].
    """
    period_ns = round(1e9 / rate)
    return _stream(profile, name, seed, range(0, max(count, 1) * period_ns, period_ns))


def _rows(profile: DirectionProfile, trace: Trace, name: str, seed: int) -> Stream:
    """Simulate one packet per row of a trace, or several per row if the trace has few rows."""
    rows = [round(time * 1e9) for time in trace.times]
    share = -(-ROWS // len(rows))
    if len(rows) == 1 or share == 1:
        return _stream(profile, name, seed, rows)
    ends = [*rows[1:], 2 * rows[-1] - rows[-2]]
    return _stream(
        profile,
        name,
        seed,
        [a + n * (b - a) // share for a, b in zip(rows, ends, strict=True) for n in range(share)],
    )


def _stream(profile: DirectionProfile, name: str, seed: int, sent_ns: Sequence[int]) -> Stream:
    from cloudrc.link.model import LinkDirection, sample
    from cloudrc.tunnel.codec import SIZES, Kind

    uplink = name == "uplink"
    kind = Kind.TELEMETRY if uplink else Kind.COMMAND
    link = LinkDirection(profile, seed, uplink)
    return sample(link, kind, sent_ns, SIZES[kind])


def _table(counted: dict[str, Numbers]) -> str:
    both = list(counted.values())

    def row(name: str, unit: str, values: list[float], scale: float = 1.0) -> list[str]:
        cells = ["-" if isnan(value) else f"{value * scale:.4g}" for value in values]
        return [name, *cells, unit]

    rows = [
        ["one way", *(counted if len(counted) > 1 else ("",)), ""],
        row("mean", "ms", [each.mean for each in both], 1e3),
        row("standard deviation", "ms", [each.deviation for each in both], 1e3),
        row("least", "ms", [each.least for each in both], 1e3),
        row("median", "ms", [each.median for each in both], 1e3),
        row("99 %", "ms", [each.p99 for each in both], 1e3),
        row("most", "ms", [each.most for each in both], 1e3),
        row("correlation with the next", "", [each.correlation for each in both]),
        row("overtaken by a later one", "%", [each.overtaken for each in both], 1e2),
        row("duplicated", "%", [each.duplicated for each in both], 1e2),
        row("lost", "%", [each.loss for each in both], 1e2),
        row("lost in a row, mean", "", [_mean(each.runs) for each in both]),
        row("lost in a row, most", "", [float(max(each.runs, default=0)) for each in both]),
    ]
    return table(rows, right=range(1, len(both) + 1))


def _mean(runs: tuple[int, ...]) -> float:
    return sum(runs) / len(runs) if runs else float("nan")
