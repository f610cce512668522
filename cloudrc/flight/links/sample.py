# SPDX-License-Identifier: Apache-2.0

"""Simulate the link alone, to draw a profile and compute its statistics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isnan, nan
from operator import attrgetter
from pathlib import Path
from statistics import fmean

from cloudrc.base.text import table
from cloudrc.config.profile import DIRECTIONS, DirectionConfig, Profile, load_profile
from cloudrc.link.doubts import describe_heavy_loss
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import LinkSchedule, Trace
from cloudrc.link.radio import slots_of
from cloudrc.link.streams import Numbers, Stream, numbers, sample
from cloudrc.link.traces import link_profile, read_trace
from cloudrc.results.report.figures.link import DirectionSample
from cloudrc.wire.tunnel.codec import SIZES, TELEMETRY_SIZES, Kind

ROWS = 1000  # least number of packets for a trace that has shares of losses
SECONDS = 30.0  # time that a figure shows by default [s]; a longer schedule is shown in full


@dataclass(frozen=True)
class SampleSettings:
    """Which packets to send; a field is the flag of this name."""

    seconds: float | None = None  # time to show [s]; None: `SECONDS`, or the whole schedule
    seed: int = 1  # of the random draws
    rate: float = 100.0  # packets per second [1/s]
    packets: int = 100_000  # for the statistics of an unchanging link


def sample_profile(
    name: str, settings: SampleSettings, tell: Callable[[str], None]
) -> tuple[str, dict[str, tuple[DirectionSample, Numbers]]]:
    """Simulate both directions of a profile, or the one of a trace, which is a file `name`.csv.

    Return the description; and direction -> packets for the figure, and statistics. `tell` receives
    a warning about a link that loses nearly all.
    """
    profile, ways = _profile(name)
    found = {}
    for way in ways:
        asked = getattr(profile, way)
        for doubt in describe_heavy_loss(asked, way):
            tell(f"warning: {doubt}")
        label = way if len(ways) > 1 else "one way"
        found[way] = _sample(asked, label, way == "uplink", settings)
    return profile.description, found


def _profile(name: str) -> tuple[Profile, Sequence[str]]:
    """Load a profile, or make one from a trace; return it, and its directions to show."""
    if not name.endswith(".csv"):
        return load_profile(name), DIRECTIONS
    path = Path(name).absolute()
    times = read_trace(path).times
    about = f"a trace of {len(times)} rows in {times[-1] - times[0]:.4g} s"
    uplink = {"trace": str(path)}
    return Profile.model_validate({"description": about, "uplink": uplink}), ("uplink",)


def _sample(
    asked: DirectionConfig, label: str, uplink: bool, settings: SampleSettings
) -> tuple[DirectionSample, Numbers]:
    """Simulate one direction of the link; return the packets for the figure, and statistics.

    If the conditions are constant, the statistics come from more packets than the figure shows.
    """
    profile = link_profile(asked)
    schedule, period_ns = LinkSchedule(profile), round(1e9 / settings.rate)
    # Telemetry of a robot with one sensor of its own.
    kind, size = Kind.COMMAND, SIZES[Kind.COMMAND]
    if uplink:
        kind, size = Kind.TELEMETRY, TELEMETRY_SIZES[1]

    def send(sent_ns: Sequence[int]) -> Stream:
        return sample(LinkDirection(profile, settings.seed, uplink), kind, sent_ns, size)

    if profile.rows is not None and settings.seconds is None:
        shown = send(_row_times(profile.rows))
    else:
        seconds = settings.seconds or max(SECONDS, 1.1e-9 * schedule.last_ns)
        count = max(1, round(seconds * settings.rate))
        shown = send(range(0, count * period_ns, period_ns))
    many = shown
    if schedule.only() is not None:
        many = send(range(0, settings.packets * period_ns, period_ns))
    return DirectionSample(label, asked, shown.sent, shown.delays, many.delays), numbers(many)


def _row_times(trace: Trace) -> list[int]:
    """Return when to send packets [ns]: one per row; several if a row loses a share of packets."""
    rows = [round(time * 1e9) for time in trace.times]
    has_shares = any(0.0 < loss < 1.0 for loss in trace.losses or ())
    many = -(-ROWS // len(rows)) if has_shares and len(rows) > 1 else 1
    ends = [*rows[1:], 2 * rows[-1] - rows[-1 - (len(rows) > 1)]]
    return [a + n * (b - a) // many for a, b in zip(rows, ends, strict=True) for n in range(many)]


STATISTICS: dict[str, tuple[str, float, Callable[[Numbers], float]]] = {
    "mean": ("ms", 1e3, attrgetter("mean")),
    "standard deviation": ("ms", 1e3, attrgetter("deviation")),
    "least": ("ms", 1e3, attrgetter("least")),
    "median": ("ms", 1e3, attrgetter("median")),
    "99 %": ("ms", 1e3, attrgetter("p99")),
    "most": ("ms", 1e3, attrgetter("most")),
    "correlation with the next": ("", 1.0, attrgetter("correlation")),
    "overtaken by a later one": ("%", 1e2, attrgetter("overtaken")),
    "duplicated": ("%", 1e2, attrgetter("duplicated")),
    "lost": ("%", 1e2, attrgetter("loss")),
    "lost in a row, mean": ("", 1.0, lambda one: fmean(one.runs) if one.runs else nan),
    "lost in a row, most": ("", 1.0, lambda one: max(one.runs, default=0)),
}
"""Name of a statistic -> unit, factor from SI to this unit, and function that gives the value."""
AT_RANDOM_PHASES = (
    "smallest at random phases",
    "mean at random phases",
    "largest at random phases",
    "more by repetitions, mean",
)
"""Names of the delays of packets that know nothing of the slots of a radio; the largest one is that
of packets which are not sent again."""


def statistics_table(ways: Mapping[str, tuple[DirectionSample, Numbers]]) -> str:
    """Format the statistics of each direction of a link for people."""
    counted = {way: found for way, (_, found) in ways.items()}
    rows = [["one way", *(counted if len(counted) > 1 else ("",)), ""]]
    for name, (unit, scale, value) in STATISTICS.items():
        values = [value(one) for one in counted.values()]
        cells = ["-" if isnan(number) else f"{number * scale:.4g}" for number in values]
        rows.append([name, *cells, unit])
    if any(shown.asked.radio for shown, _ in ways.values()):
        delays = [
            _at_random_phases(shown.asked, uplink=way == "uplink")
            for way, (shown, _) in ways.items()
        ]
        for name, row in zip(AT_RANDOM_PHASES, zip(*delays, strict=True), strict=True):
            rows.append([name, *(f"{delay:.4g}" for delay in row), "ms"])
    return table(rows, right=range(1, len(counted) + 1))


def _at_random_phases(asked: DirectionConfig, *, uplink: bool) -> tuple[float, ...]:
    """Return the values of `AT_RANDOM_PHASES` for a direction without jitter [ms]."""
    if asked.radio is None:
        return *(asked.delay_ms,) * 3, 0.0
    found = slots_of(asked.radio, uplink)
    return *(asked.delay_ms + each * 1e-6 for each in found.span), found.repeats_ns * 1e-6
