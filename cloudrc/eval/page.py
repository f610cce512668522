"""Draw the figure of an evaluation, and make its page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from html import escape
from math import nan
from pathlib import Path
from string import Template

from cloudrc.eval.results import SEEDLESS, EvalOutcome, cells, describe_success
from cloudrc.eval.setup import MEASURED, EvalSetup
from cloudrc.files import write_atomically
from cloudrc.report.figures.bands import Panel, Point, draw
from cloudrc.report.figures.style import Look
from cloudrc.source import code_hash
from cloudrc.version import __version__

FIGURE, PAGE = "figure", "report.html"
WIDTH = 5.0  # of the figure [in]
CAPTION = (
    "Each point: all episodes of a condition. Success: share, with the 95 % interval of Clopper "
    "and Pearson. Return: median, with its 95 % interval from 6 episodes on. The other numbers are "
    "means. All conditions have the same seeds, so that they meet the same environments and "
    "networks."
)
MEASURED_TIME = (
    "Not repeatable: the time for an answer was measured on this machine, so that the rows have no "
    "hash."
)
TEMPLATE = Template("""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0 }
td, th { padding: .2rem .7rem; border-bottom: 1px solid #ccc; text-align: right }
svg { max-width: 100%; height: auto }
.warning { color: #7a5200 }
</style>
<h1>$title</h1>
<p>$facts</p>
$warning
$figure
<p>$caption</p>
<table>$table</table>
<p>cloudrc $version, code $code. Rows: <code>rows.jsonl</code>, summary: <code>eval.json</code>.</p>
</html>
""")


def write_page(folder: Path, setup: EvalSetup, outcomes: Sequence[EvalOutcome]) -> Path:
    """Write the figure and the page into `folder`; return the path of the page."""
    pictures = draw_outcomes(outcomes)
    for kind, data in pictures.items():
        write_atomically(folder / f"{FIGURE}.{kind}", data)
    svg = pictures["svg"].decode()
    head, *rows = cells(outcomes)
    lines = ["".join(f"<th>{escape(each)}</th>" for each in head)]
    lines += ["".join(f"<td>{escape(each)}</td>" for each in row) for row in rows]
    page = TEMPLATE.substitute(
        title=escape(f"{setup.env}: {Path(setup.policy).name} over {setup.link}"),
        facts=escape(_facts(setup, outcomes)),
        warning="".join(f'<p class="warning">{escape(each)}</p>' for each in _warnings(setup)),
        figure=svg[svg.index("<svg") :],
        caption=CAPTION,
        table="".join(f"<tr>{line}</tr>" for line in lines),
        version=__version__,
        code=code_hash(),
    )
    write_atomically(folder / PAGE, page.encode())
    return folder / PAGE


def _warnings(setup: EvalSetup) -> list[str]:
    found = [(setup.is_measured, MEASURED_TIME), (not setup.follows_seed, SEEDLESS)]
    return [text for applies, text in found if applies]


def _facts(setup: EvalSetup, outcomes: Sequence[EvalOutcome]) -> str:
    compute = setup.compute
    if isinstance(compute, tuple):
        is_measured = compute[0] == MEASURED
        time = "measured" if is_measured else " ".join(map(str, compute))
    else:
        time = f"{compute:g} s"
    count = max(each.episodes for each in outcomes)
    words = f"{count} episodes per condition; time for an answer: {time}; success: "
    return f"{words}{describe_success(setup, outcomes)}."


def draw_outcomes(outcomes: Sequence[EvalOutcome]) -> dict[str, bytes]:
    """Draw success or return, steps without a new action, and the observation's age.

    Return the figure as PDF, PNG and SVG by suffix.
    """
    known = all(each.successes is not None for each in outcomes)
    first = Panel("success", "%", _lines(outcomes, _success))
    if not known:
        first = Panel("return", "", _lines(outcomes, _total))
    panels = [
        first,
        Panel("steps without a new action", "%", _lines(outcomes, _mean("stale_share", 100.0))),
        Panel("age of the observation", "ms", _lines(outcomes, _mean("observation_age", 1e3))),
    ]
    has_axis = all(each.rtt_ms is not None for each in outcomes)
    names = [] if has_axis else ["profile's"]
    return draw(panels, "round trip_ms", names, "executor", look=Look(width=WIDTH))


Summary = Callable[[EvalOutcome], tuple[float, float, float]]
"""Function that returns a value and its interval."""


def _lines(outcomes: Sequence[EvalOutcome], summarise: Summary) -> dict[str, list[Point]]:
    found = dict[str, list[Point]]()
    for each in sorted(outcomes, key=lambda each: each.rtt_ms or 0.0):
        point = Point(each.rtt_ms or 0.0, *summarise(each), False)
        found.setdefault(each.executor, []).append(point)
    return found


def _success(outcome: EvalOutcome) -> tuple[float, float, float]:
    low, high = outcome.success_interval or (nan, nan)
    return 100.0 * (outcome.successes or 0) / outcome.episodes, 100.0 * low, 100.0 * high


def _total(outcome: EvalOutcome) -> tuple[float, float, float]:
    return outcome.total, *(outcome.total_interval or (nan, nan))


def _mean(name: str, factor: float) -> Summary:
    def summarise(outcome: EvalOutcome) -> tuple[float, float, float]:
        return factor * outcome.means.get(name, nan), nan, nan

    return summarise
