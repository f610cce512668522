# SPDX-License-Identifier: Apache-2.0

"""Draw the figure of an evaluation, and make its page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from math import nan
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from cloudrc.base.files import write_atomically
from cloudrc.base.outside.document import write_yaml
from cloudrc.base.text import cells
from cloudrc.gym.loop import AGES
from cloudrc.gym.options import compute_times
from cloudrc.results.report.figures import PRINT_KINDS, own_settings, save
from cloudrc.results.report.figures.bands import Panel, Point, draw
from cloudrc.results.report.figures.style import Look, new_figure, panel
from cloudrc.results.report.figures.tails import draw_tails
from cloudrc.studies.eval.evidence import place
from cloudrc.studies.eval.results import COLUMNS, LEGEND, SEEDLESS, TESTS
from cloudrc.studies.eval.setup import BASELINE, EvalSetup

FIGURE, TAILS, PAGE = "figure", "ages", "report.html"
WIDTH = 5.0  # of a figure [in]
CAPTION = (
    "Each point: all episodes of a condition, at the measured time from an observation to its "
    "action. Dashed: without a network. Success: share, with the 95 % interval of Clopper and "
    "Pearson. Return and length: median, with its 95 % interval from 6 episodes on. Age: mean over "
    "the steps, up to the mean of the episodes' p99. All conditions have the same seeds, so that "
    "they meet the same environments and networks. Hollow: all episodes ended before an answer to "
    "an observation over the network could act; the point is at the asked time."
)
TAILS_CAPTION = (
    "Age of the observation behind an action, a line for each round trip: the share of the steps "
    "in which it is higher, from the first observation that has crossed the link on. Dashed and "
    "grey: --deadline."
)
AGE = "age of the observation behind an action"
PANELS = (
    ("success", "%", "success", "success_low", "success_high"),
    ("return", "", "return", "return_low", "return_high"),
    ("length of an episode", "steps", "steps", "steps_low", "steps_high"),
    ("episodes that the environment terminated", "%", "terminated_share", "", ""),
    ("steps without a new action", "%", "stale_share", "", ""),
    (AGE, "ms", "action_age_ms", "action_age_ms", "action_age_p99_ms"),
)
"""Title and unit; keys of an outcome: value, and its interval if there is one."""
MEASURED_TIME = (
    "Not repeatable: the time for an answer was measured on this machine, so that the rows have no "
    "hash."
)
TEMPLATE = Template("""<!doctype html>
<html lang="en"><meta charset="utf-8"><title>$title</title>
<style>
body { font: 15px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem }
table { border-collapse: collapse; margin: 1rem 0; font-size: 13px; white-space: nowrap }
td, th { padding: .2rem .4rem; border-bottom: 1px solid #ccc; text-align: right }
svg { max-width: 100%; height: auto }
pre { white-space: pre-wrap }
.warning { color: #7a5200 }
</style>
<h1>$title</h1>
<p>$facts</p>
$warning
$figure
<p>$caption</p>
$tails
<p>$tails_caption</p>
<table>$table</table>
<p>$legend</p>
$notes
<table>$tests</table>
<p>Made by <code>$command</code></p>
<pre>$made</pre>
<p>To cite: $cite</p>
<p>Rows: <code>rows.jsonl</code>, summary: <code>eval.json</code>.</p>
</html>
""")


def write_page(folder: Path, setup: EvalSetup, document: Mapping[str, Any]) -> Path:
    """Write the figures and the page into `folder`; return the path of the page.

    `document` is the content of the file of the evaluation.
    """
    outcomes = document["outcomes"]
    compute = 0.0 if setup.is_measured else compute_times(setup.compute_times)[0]
    figure = draw_outcomes(outcomes, compute)
    tails = draw_ages(outcomes, document["step"]["seconds"], setup.deadline)
    for name, pictures in ((FIGURE, figure), (TAILS, tails)):
        for kind, data in pictures.items():
            write_atomically(folder / f"{name}.{kind}", data)
    count = outcomes[0]["episodes"]
    made = {key: document[key] for key in ("date", "versions", "compute", "link", "profile")}
    warnings = [MEASURED_TIME] * setup.is_measured + [SEEDLESS] * (not setup.follows_seed)
    page = TEMPLATE.substitute(
        title=escape(f"{setup.env}: {Path(setup.policy).name} over {setup.link}"),
        facts=escape(
            f"{count} episodes per condition; {setup.facts}; success: {document['success']}."
        ),
        warning=_paragraphs(warnings, ' class="warning"'),
        figure=_inline(figure),
        caption=CAPTION,
        tails=_inline(tails),
        tails_caption=TAILS_CAPTION,
        table=_table(cells(outcomes, COLUMNS)),
        legend=LEGEND,
        notes=_paragraphs(document["notes"]),
        tests=_table(cells(document["tests"], TESTS)),
        made=escape(write_yaml(made)),
        **{key: escape(document[key]) for key in ("command", "cite")},
    )
    write_atomically(folder / PAGE, page.encode())
    return folder / PAGE


def _inline(pictures: Mapping[str, bytes]) -> str:
    svg = pictures["svg"].decode()
    return svg[svg.index("<svg") :]


def _paragraphs(texts: Sequence[str], kind: str = "") -> str:
    return "".join(f"<p{kind}>{escape(each)}</p>" for each in texts)


def _table(rows: Sequence[Sequence[str]]) -> str:
    lines = ["".join(f"<td>{escape(each)}</td>" for each in row) for row in rows]
    lines[:1] = [line.replace("td>", "th>") for line in lines[:1]]
    return "".join(f"<tr>{line}</tr>" for line in lines)


def draw_outcomes(outcomes: Sequence[Mapping[str, Any]], compute: float) -> dict[str, bytes]:
    """Draw success or return, the episodes' lengths and ends, and what the robot acts on.

    `compute` is the mean time for an answer [s]. Return the figure as PDF, PNG and SVG by suffix.
    """
    left_out = "return" if "success" in outcomes[0] else "success"
    panels = [panel_of(outcomes, compute, *each) for each in PANELS if left_out not in each]
    return draw(
        panels,
        "age of the loop_ms",
        [],
        "executor",
        look=Look(width=WIDTH),
        hollow="hollow: no answer in time",
    )


def panel_of(
    outcomes: Sequence[Mapping[str, Any]], compute: float, title: str, unit: str, *keys: str
) -> Panel:
    """Return a panel of `PANELS`; `compute` is the mean time for an answer [s]."""
    lines, factor = dict[str, list[Point]](), 100.0 if unit == "%" else 1.0
    for each in outcomes:
        middle, low, high = (factor * each.get(key, nan) for key in keys)
        answered = "loop_age_ms" in each
        age = each["loop_age_ms"] if answered else _asked_age_ms(each, compute)
        point = Point(age, middle, low, high, not answered)
        lines.setdefault(each["executor"], []).append(point)
    return Panel(title, unit, lines, lines.pop(BASELINE)[0].middle)


def _asked_age_ms(outcome: Mapping[str, Any], compute: float) -> float:
    """Return the mean time from an observation to its answer that was asked for [ms]."""
    up, down = (outcome.get(f"delay_asked_{way}_ms", nan) for way in ("uplink", "downlink"))
    return float(up + down + 1e3 * compute)


def draw_ages(
    outcomes: Sequence[Mapping[str, Any]], dt: float, deadline: float | None
) -> dict[str, bytes]:
    """Draw the distribution of the actions' ages: a panel per executor, a line per round trip.

    `dt` is the time of a step [s]. A `deadline` [s] is a dashed line.
    Return the figure as PDF, PNG and SVG by suffix.
    """
    panels = dict[str, dict[str, Any]]()
    for each in outcomes[1:]:
        counts = np.array(each["age_counts"])
        share = np.append(1.0, 1.0 - counts.cumsum() / counts.sum())
        ages = np.append(0.0, np.arange(len(counts)) * dt)
        tail = ages[:AGES], share[:AGES]  # the last count has older ones, too
        panels.setdefault(each["executor"], {})[place(each["rtt_ms"])] = tail
    with own_settings(Look(width=WIDTH)):
        figure = new_figure(1.0 + 1.5 * len(panels), WIDTH)
        column = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
        for n, (axes, (name, lines)) in enumerate(zip(column, panels.items(), strict=True)):
            draw_tails(axes, lines, deadline, drawstyle="steps-post")
            panel(axes, chr(ord("a") + n), name)
        column[-1].set_xlabel("age, x (ms)")
        handles = column[0].get_legend_handles_labels()
        shape = {"ncols": 4, "alignment": "left"}
        figure.legend(*handles, loc="outside upper left", title="round trip", **shape)
        return {kind: save(figure, kind) for kind in PRINT_KINDS}
