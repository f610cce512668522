# SPDX-License-Identifier: Apache-2.0

"""Draw what a radio that schedules does to delays, and fly the tables about it: `make results`.

`python -m tools.radio picture` draws docs/radio.png alone, in seconds.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import cloudrc.link
from cloudrc.base.statistics import median_interval
from cloudrc.results.report.figures import own_settings, save
from cloudrc.results.report.figures.style import Look, dots, legend_above, new_figure, panel
from tools.markdown import table

DOCS = Path(__file__).resolve().parents[1] / "docs"
DELAY_MS, PPM, RATE = 3.0, 50.0, 100
ERROR, AGE = "prediction_error_rms", "age_at_actuator_mean"
WAYS = {
    "requests, 100 Hz": (100, 10.0, "#0072B2", "-"),
    "requests, 125 Hz": (125, 10.0, "#D55E00", "--"),
    "configured grant, 100 Hz": (100, 0.0, "#009E73", "-."),
}
"""Name -> packets a second [1/s], `request_ms`, colour and dashes."""


def delays(count: int, rate: float, **radio: Any) -> Any:
    """Return the delays of packets at a `rate` [1/s] in the uplink of `5g-sa` [ms], shape (n,)."""
    uplink, _ = cloudrc.link.open({"uplink": {"delay_ms": DELAY_MS, "radio": radio}}, 1)
    return uplink.table(count, 1 / rate) * 1e3


def draw() -> bytes:
    """Draw the mean delay over the phase, and the delay of clocks that drift; return a PNG."""
    with own_settings(Look()):
        figure = new_figure(2.6)
        left, right = figure.subplots(1, 2)
        panel(left, "a", "the phase decides")
        phases = np.arange(0.0, 10.0, 0.05)
        for name, (rate, request_ms, colour, dashes) in WAYS.items():
            means = [
                delays(40, rate, phase_ms=phase, request_ms=request_ms, error=0).mean()
                for phase in phases.tolist()
            ]
            left.plot(phases, means, color=colour, ls=dashes, label=name)
        left.set(xlabel="phase of the telemetry (ms)", ylabel="mean delay of the uplink (ms)")
        left.set_ylim(0, 21)
        left.legend(loc="upper right")
        panel(right, "b", "clocks that are 50 ppm apart")
        count = 240 * RATE
        time = np.arange(count) / RATE
        plain = cloudrc.link.open("5g", 1)[0].table(count, 1 / RATE) * 1e3
        dots(right, time[::4], plain[::4], "#bdbdbd", "5g")
        drifting = delays(count, RATE, drift_ppm=PPM)
        dots(right, time[::2], drifting[::2], "#0072B2", "5g-sa, drifting")
        right.set(xlabel="time (s)", ylabel="delay of the uplink (ms)", ylim=(0, 32), xlim=(0, 240))
        legend_above(right)
        return save(figure, "png")


def fly(name: str, folder: Path) -> list[dict[str, Any]]:
    """Fly a sweep of the documentation into a folder, or read it there; return its rows."""
    from tools.results import fly

    found = folder / name / "rows.jsonl"
    if found.exists():
        return [json.loads(line) for line in found.read_text().splitlines()]
    return fly(name, folder / name)


def told(rows: Sequence[dict[str, Any]], number: str, unit: float) -> str:
    """Return the median of a number with its interval, in `unit` of SI."""
    values = [row["numbers"][number] / unit for row in rows]
    low, high = median_interval(values) or (min(values), max(values))
    return f"{median(values):.1f} [{low:.1f}, {high:.1f}]"


def by(rows: Sequence[dict[str, Any]], key: str) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each value that a key of their points has."""
    found: dict[str, list[dict[str, Any]]] = {}
    for row in rows:
        found.setdefault(row["point"][key], []).append(row)
    return found


def predictors(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of prediction errors: predictors x links."""

    def cells() -> Iterator[list[str]]:
        for name, mine in by(rows, "predictor").items():
            yield [f"`{name}`", *(told(part, ERROR, 1e-3) for part in by(mine, "link").values())]

    return table(" | ".join(["predictor", *by(rows, "link")]), cells())


def remedies(rows: Sequence[dict[str, Any]]) -> str:
    """Return the table of ages and prediction errors: links x predictors."""
    names = by(rows, "predictor")

    def cells() -> Iterator[list[str]]:
        for link, mine in by(rows, "link").items():
            parts = by(mine, "predictor")
            errors = [told(parts[name], ERROR, 1e-3) for name in names]
            yield [link, told(parts["last_sample"], AGE, 1e-3), *errors]

    columns = ["link", "mean age at the robot [ms]", *(f"error, `{name}` [mm]" for name in names)]
    return table(" | ".join(columns), cells())


def write(page: Path, made: str, tool: str = "tools.radio") -> None:
    """Put a table into its place on a page, between the marks of the `tool` that made it."""
    begin, end = f"<!-- made by `python -m {tool}` -->\n", f"<!-- end of {tool} -->\n"
    before, _, rest = page.read_text("utf-8").partition(begin)
    _, _, after = rest.partition(end)
    page.write_text(before + begin + made + end + after, "utf-8")


def main() -> None:
    """Draw the picture; then fly both sweeps into the named folder, and write the tables."""
    (DOCS / "radio.png").write_bytes(draw())
    if sys.argv[1:] == ["picture"]:
        return
    with TemporaryDirectory() as made:
        folder = Path(sys.argv[1] if sys.argv[1:] else made)
        write(DOCS / "results.md", predictors(fly("radio", folder)))
        write(DOCS / "link.md", remedies(fly("radio-rates", folder)))


if __name__ == "__main__":
    main()
