# SPDX-License-Identifier: Apache-2.0

"""Make the page report.html of a fleet, with its figure."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from cloudrc.base.files import write_atomically
from cloudrc.config.resolved import dump
from cloudrc.results.report.figures import own_settings, save
from cloudrc.results.report.figures.style import (
    BLACK,
    BLUE,
    DOWNLINK,
    GREY,
    UPLINK,
    VERMILION,
    Look,
    legend_above,
    new_figure,
    panel,
)
from cloudrc.results.report.fleet import FleetFlown, by_direction, remarks, tables
from cloudrc.results.report.page import HEADLINES, REPEAT
from cloudrc.version import __version__

CAPTION = (
    "Age of information at the actuator of each robot: dot: mean; line: up to the 99th "
    "percentile; red: the robot failed. Above the dashed line the guard holds a robot. "
)
WAITS = "Right: the longest wait of a packet in the cell, in each tenth of a second."
LONG = 20
"""Number of characters from which a text in a table may have several lines."""
COLOURS = {"uplink": UPLINK, "downlink": DOWNLINK, "both": BLACK}
BODY = Template("""<body>
<header>
<p class="kicker">$kicker</p>
<h1><span class="verdict">$verdict</span> $headline</h1>
$notes
</header>
<main>
<figure><img src="data:image/svg+xml;base64,$figure" alt="$caption">
<figcaption><b>Fig. 1.</b> $caption</figcaption></figure>
$tables
<h2>Repeat this run</h2>
<p>$repeat</p>
<pre>cloudrc run config.yaml --mode $mode</pre>
<p>The first robot alone, and its page in the folder of this run:</p>
<pre>cloudrc run config.yaml --mode $mode --set fleet.only=$first --set cell.rate_kbit=null
cloudrc report robot-$first</pre>
<details><summary>Complete experiment (<code>config.yaml</code>)</summary>
<pre>$config</pre></details>
</main>
<footer>Made by cloudrc $version.</footer>
</body>
</html>
""")


def write_fleet_page(folder: Path, flown: FleetFlown, document: Mapping[str, Any]) -> None:
    """Write the page of a fleet into `folder`; `document` is the content of its report.json."""
    experiment, count = flown.experiment, len(flown.robots)
    _, accent = HEADLINES[document["verdict"]]
    name = f"{experiment.name}: {count} robots"
    page = files("cloudrc.results.report").joinpath("page.html").read_text("utf-8")
    facts = {"version": escape(__version__), "accent": accent, "title": escape(name)}
    notes = [*(failure["text"] for failure in document["failures"]), *remarks(document)]
    body = BODY.substitute(
        facts,
        kicker=escape(f"cloudrc fleet report · {name} · seed {experiment.seed}"),
        verdict=escape(document["verdict"].upper()),
        headline=f"{document['succeeded']} of {count} robots succeeded.",
        notes="".join(f"<p>{escape(note[0].upper() + note[1:])}.</p>" for note in notes),
        figure=b64encode(_draw(flown, document)).decode(),
        caption=escape(CAPTION + WAITS * bool(flown.log)),
        tables="\n".join(map(_table, tables(document))),
        first=flown.robots[0]["robot"],
        mode=flown.mode,
        repeat=escape(REPEAT[flown.mode == "virtual"]),
        config=escape(dump(experiment)),
    )
    text = Template(page.partition("<body>")[0]).substitute(facts) + body
    write_atomically(folder / "report.html", text.encode("utf-8"))


def _table(rows: Sequence[Sequence[str]]) -> str:
    """Return a table as HTML; the first row has the heads."""
    lines = ["".join(map(_cell, row)) for row in rows[1:]]
    heads = "".join(f'<th style="text-align: right">{escape(each)}</th>' for each in rows[0])
    body = "\n".join(f"<tr>{line}</tr>" for line in lines)
    inner = f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody>"
    return f'<table style="margin-top: 2rem">{inner}</table>'


def _cell(text: str) -> str:
    """Return a cell of a table: a verdict has its colour, and a long text has several lines."""
    shown, kind = escape(text), "value" if len(text) < LONG else "text"
    if text in HEADLINES:
        _, colour = HEADLINES[text]
        shown = f'<span class="verdict" style="--accent: {colour}">{shown}</span>'
    return f'<td class="{kind}">{shown}</td>'


def _draw(flown: FleetFlown, document: Mapping[str, Any]) -> bytes:
    """Draw the ages of all robots and, if there is a cell, its waits over time, as SVG."""
    look = Look()
    with own_settings(look):
        if flown.log:
            figure, (ages, waits) = look.two_panels()
            _draw_waits(waits, flown)
        else:
            figure = new_figure(2.6, look.width)
            ages = figure.subplots()
        limit_ms = flown.experiment.guard.command_age_max_ms
        ages.axhline(limit_ms, color=GREY, linestyle="--", linewidth=0.8)
        for robot in document["robots"]:
            if "age_ms" in robot:
                at, ages_ms = [robot["robot"]] * 2, [robot["age_ms"], robot["age_p99_ms"]]
                colour = BLUE if robot["verdict"] == "success" else VERMILION
                ages.plot(at, ages_ms, "o-", ms=3, markevery=[0], color=colour)
        ages.set(xlabel="robot", ylabel="age [ms]", ylim=(0, None))
        ages.xaxis.set_major_locator(MaxNLocator(integer=True))
        panel(ages, "a")
        return save(figure, "svg")


def _draw_waits(axes: Axes, flown: FleetFlown) -> None:
    for way, done in by_direction(flown.log).items():
        waits, times = [each.longest_ns * 1e-6 for each in done], [each.time_s for each in done]
        axes.plot(times, waits, color=COLOURS[way], label=way, linewidth=0.8)
    axes.set(xlabel="time [s]", ylabel="longest wait [ms]", ylim=(0, None))
    panel(axes, "b")
    legend_above(axes)
