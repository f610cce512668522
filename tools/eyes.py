# SPDX-License-Identifier: Apache-2.0

"""Fly what docs/results.md says about a camera on the uplink: a part of `make results`.

`python -m tools.eyes PART [FOLDER]` makes one part: `losses` and `delays` fly sweeps, `lanes` flies
one robot in a cell. Rows that FOLDER has are not flown again. It needs EGL and the extra `camera`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from math import degrees
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from matplotlib.axes import Axes

from cloudrc.base.statistics import median_interval
from cloudrc.flight.experiment import load, robots_of
from cloudrc.flight.fleet import fly_fleet
from cloudrc.results.report.figures import own_settings, save
from cloudrc.results.report.figures.style import BLUE, GREY, VERMILION, Look, new_figure, panel
from tools.markdown import table
from tools.radio import DOCS, by, fly, write

PAGE = DOCS / "results.md"
MEDIANS = {57: "5G SA, edge", 68: "5G NSA, edge", 106: "5G SA, cloud", 140: "5G NSA, cloud"}
"""Median time from a picture to its command [ms] -> network and place, of a follow-me drone.
Source: "Is the edge really necessary for drone computing offloading? An experimental assessment in
carrier-grade 5G operator networks", Software: Practice and Experience 53 (3), 2023,
doi:10.1002/spe.3161."""
QUEUES, RATES, SEEDS = ("fifo", "priority"), (0, 200, 400, 600, 700), 10
"""Queues of the cell, bit rates of the video [kbit/s], flights of each."""
LANES = (
    *("cell.rate_kbit=1000", "link.both.delay_ms=20", "world.wind.gust_mps=1"),
    "mission.follow.duration_s=8",
)
VIDEO = "camera.codec=h264", "camera.keep=false"
BLIND = "camera=null", "cloud.perception=null"
"""Settings of all flights in a cell, of those with video, and of those without; there the robot
hovers."""

Numbers = Sequence[float]


def middle(values: Numbers, digits: int, unit: float = 1.0) -> str:
    """Return the median of values with its interval, in `unit`; alone where all are equal."""
    low, high = median_interval(values) or (min(values), max(values))
    shown, *limits = (f"{value / unit:.{digits}f}" for value in (median(values), low, high))
    return shown if {*limits} == {shown} else f"{shown} [{', '.join(limits)}]"


def aged(values: Numbers) -> str:
    """Return the median of ages with its interval [ms]; a dash if a flight has none."""
    return middle(values, 1, 1e-3) if max(values) < float("inf") else "-"


def of(rows: Sequence[Mapping[str, Any]], number: str) -> list[float]:
    """Return a number of rows; a flight without it counts as infinite."""
    return [row["numbers"].get(number, float("inf")) for row in rows]


def losses(folder: Path) -> str:
    """Return the table of pictures that arrive: uplinks and losses x codecs."""
    whole = by(fly("camera", folder), "uplink")
    lossy = by(fly("camera-loss", folder), "link.uplink.loss")
    named = whole | {f"2 Mbit/s, {float(loss):.0%} loss": rows for loss, rows in lossy.items()}

    def cells() -> Iterator[list[str]]:
        for uplink, mine in named.items():
            for codec, rows in by(mine, "codec").items():
                names = (f"frame_age_{each}" for each in ("mean", "p99", "max"))
                ages = [middle(of(rows, name), 0, 1e-3) for name in names]
                rate, shown = middle(of(rows, "video_kbit"), 0), middle(of(rows, "frames_shown"), 2)
                away = middle(of(rows, "out_of_view"), 0, 0.01)
                yield [uplink, codec, str(len(rows)), rate, shown, *ages, away]

    return table(
        "uplink | codec | flights | kbit/s | pictures shown | age of the newest [ms] | p99 [ms] "
        "| peak [ms] | out of view [%]",
        cells(),
    )


def delays(folder: Path) -> str:
    """Draw docs/follow.png; return the table of round trips."""
    points = dict(sorted(by(fly("follow", folder), "link.both.delay_ms").items()))
    (DOCS / "follow.png").write_bytes(draw_delays([*points.values()]))

    def cells() -> Iterator[list[str]]:
        for delay, rows in points.items():
            names = "frame_age_mean", "seen_to_acted"
            ages = [aged(of(rows, name)) for name in names]
            error = [degrees(each) for each in of(rows, "bearing_error_rms")]
            yield [
                f"{2 * float(delay):g} ms",
                *ages,
                middle(error, 1),
                middle(of(rows, "out_of_view"), 0, 0.01),
                f"{sum(row['verdict'] == 'success' for row in rows)}/{len(rows)}",
            ]

    return table(
        "round trip | age of the newest picture [ms] | from picture to action [ms] "
        "| bearing error, RMS [°] | out of view [%] | never for 2 s",
        cells(),
    )


def line(axes: Axes, x: Numbers, points: Sequence[Numbers], colour: str, name: str = "") -> None:
    """Draw the medians of the flights of each point, and their intervals."""
    limits = [median_interval(each) or (min(each), max(each)) for each in points]
    axes.fill_between(x, *zip(*limits, strict=True), color=colour, alpha=0.18, lw=0)
    axes.plot(x, [median(each) for each in points], "o-", ms=3, color=colour, label=name)


def draw_delays(points: Sequence[Sequence[Mapping[str, Any]]]) -> bytes:
    """Draw bearing error and time out of view over the time from picture to action; return a PNG.

    `points` has the rows of each round trip.
    """
    with own_settings(Look()):
        figure = new_figure(2.7)
        left, right = figure.subplots(1, 2)
        x = [median(of(rows, "seen_to_acted")) * 1e3 for rows in points]
        for axes, number, unit in (
            (left, "bearing_error_rms", degrees(1)),
            (right, "out_of_view", 100.0),
        ):
            line(axes, x, [[unit * each for each in of(rows, number)] for rows in points], BLUE)
            for at in MEDIANS:
                axes.axvline(at, color=GREY, lw=0.9, ls=":", zorder=1)
            axes.set(xlabel="from picture to action (ms)", xlim=(0, 620))
            axes.set_ylim(bottom=0)
        for at, (time_ms, name) in enumerate(MEDIANS.items()):
            place = (200, 0.93 - 0.08 * at)
            right.text(*place, f"{time_ms} ms: {name}", transform=right.get_xaxis_transform())
        panel(left, "a", "bearing error, RMS (°)")
        panel(right, "b", "time out of view (%)")
        return save(figure, "png")


def fly_lanes(folder: Path) -> list[dict[str, Any]]:
    """Fly one robot in a cell with each queue and bit rate; return the rows."""
    found = folder / "lanes.jsonl"
    lines = found.read_text("utf-8").splitlines() if found.exists() else []
    rows = [json.loads(each) for each in lines]
    known = [(row["point"], row["seed"]) for row in rows]
    for seed in range(1, SEEDS + 1):
        for rate in RATES:
            for queue in QUEUES if rate else QUEUES[:1]:
                point = {"kbit": rate, "queue": queue}
                if (point, seed) not in known:
                    row = {"point": point, "seed": seed, "numbers": fly_lane(queue, rate, seed)}
                    rows.append(row)
                    with found.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(row) + "\n")
    return rows


def fly_lane(queue: str, kbit: int, seed: int) -> dict[str, float]:
    """Fly once, as `cloudrc run follow --mode virtual` with these settings; return the numbers."""
    video = (*VIDEO, f"camera.kbit={kbit}") if kbit else BLIND
    settings = [*LANES, f"cell.queue={queue}", *video]
    cell = load("follow", settings, seed, fleets=True)
    with TemporaryDirectory() as made:
        fly_fleet(
            cell, robots_of(cell, "follow", settings, seed), "virtual", Path(made), page=False
        )
        report = json.loads(Path(made, "robot-0", "report.json").read_text("utf-8"))
    return {name: each["value"] for name, each in report["numbers"].items()}


def lanes(folder: Path) -> str:
    """Draw docs/lanes.png; return the table of bit rates."""
    rows = fly_lanes(folder)
    (DOCS / "lanes.png").write_bytes(draw_lanes(rows))

    def cells() -> Iterator[list[str]]:
        for kbit, mine in sorted(by(rows, "kbit").items()):
            queues = by(mine, "queue")
            numbers = "age_at_actuator_mean", "age_at_actuator_p99", "frame_age_mean"
            pairs = [[aged(of(each, name)) for each in queues.values()] for name in numbers]
            yield [str(kbit), str(len(queues["fifo"])), *(" → ".join(pair) for pair in pairs)]

    return table(
        "video [kbit/s] | flights | age of the loop, mean [ms] | p99 [ms] "
        "| age of the picture, mean [ms]",
        cells(),
    )


def draw_lanes(rows: Sequence[dict[str, Any]]) -> bytes:
    """Draw the ages of loop and pictures over the bit rate of the video; return a PNG."""
    with own_settings(Look()):
        figure = new_figure(2.7)
        left, right = figure.subplots(1, 2)
        for queue, colour in zip(QUEUES, (VERMILION, BLUE), strict=True):
            mine = [
                row for row in rows if row["point"]["queue"] == queue or not row["point"]["kbit"]
            ]
            points = dict(sorted(by(mine, "kbit").items()))
            for axes, number in ((left, "age_at_actuator_p99"), (right, "frame_age_mean")):
                ages = {kbit: of(each, number) for kbit, each in points.items()}
                known = {kbit: each for kbit, each in ages.items() if max(each) < float("inf")}
                age_ms = [[1e3 * age for age in each] for each in known.values()]
                line(axes, [float(kbit) for kbit in known], age_ms, colour, queue)
        for axes in (left, right):
            axes.set(xlabel="video (kbit/s)", xlim=(0, 720))
            axes.set_ylim(bottom=0)
        left.legend(loc="upper left")
        panel(left, "a", "age of the loop, p99 (ms)")
        panel(right, "b", "age of the newest picture, mean (ms)")
        return save(figure, "png")


PARTS = {"losses": losses, "delays": delays, "lanes": lanes}
"""Name of a part -> what flies it and returns its table."""


def main(words: Sequence[str]) -> None:
    """Make the named part, or all, from flights in the named folder, or in a new one."""
    part, *where = [*words, ""]
    with TemporaryDirectory() as made:
        folder = Path(where[0] if where[:-1] else made)
        for name in [part] if part else PARTS:
            write(PAGE, PARTS[name](folder), f"tools.eyes {name}")


if __name__ == "__main__":
    main(sys.argv[1:])
