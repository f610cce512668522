# SPDX-License-Identifier: Apache-2.0

"""Make the page report.html with the verdict, the main numbers, all numbers and figures.

The page is one file with all pictures. It uses the reader's fonts and loads nothing from a network.
"""

from __future__ import annotations

import json
from base64 import b64encode
from collections import defaultdict
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from importlib.resources import files
from string import Template
from typing import Any

from cloudrc.config.resolved import ResolvedExperiment, dump
from cloudrc.results.metrics.flight import Flight
from cloudrc.results.metrics.measure import Number
from cloudrc.results.metrics.verdict import FlightFailure
from cloudrc.results.record import wall_time
from cloudrc.results.report.document import Assessment, Run
from cloudrc.results.report.figures import Picture
from cloudrc.results.report.figures.style import PAGE
from cloudrc.results.report.summary import in_groups, main_numbers, readable
from cloudrc.version import __version__

HEADLINES = {
    "success": ("The mission succeeded.", "#00694b"),
    "failure": ("The mission failed.", "#a33a00"),
    "invalid": ("The run is invalid: it proves no success.", "#7a5200"),
    "interrupted": ("The run was interrupted.", "#7a5200"),
}
"""Outcome of the verdict -> headline and colour of the page."""
REPEAT = {
    True: "Run this in the folder of the report; the records will be identical:",
    False: "Run this in the folder of the report. The random numbers of the link come from the "
    "same seed. The timing of the machine differs between runs, so the numbers will be close but "
    "not identical:",
}
"""Whether the run was in virtual time -> text above the command that repeats the run."""


def render(
    assessment: Assessment,
    pictures: Sequence[Picture],
    environment: Mapping[str, Any],
    replay: str = "",
    polar: str = "",
    still: Picture | None = None,
) -> str:
    """Return the HTML of the page.

    `environment` is the content of environment.json, `replay` the HTML of the 3-D replay or of a
    line that says why there is none, `polar` that of the scans, "" without any. Readers see `still`
    where the browser draws no 3-D.
    """
    run, experiment, verdict = assessment.run, assessment.experiment, assessment.verdict
    headline, accent = HEADLINES[verdict.outcome]
    digest = assessment.records_sha256
    kicker = f"cloudrc run report · {experiment.name} · {run.mode} · seed {experiment.seed}"
    return Template(files(__package__).joinpath("page.html").read_text("utf-8")).substitute(
        version=escape(__version__),
        title=escape(f"{experiment.name}: {verdict.outcome}"),
        accent=accent,
        kicker=escape(kicker),
        verdict=escape(verdict.outcome.upper()),
        headline=escape(headline),
        summary=_pairs(
            {text: f"{n} {unit}".rstrip() for text, n, unit in main_numbers(assessment.numbers)}
        ),
        failures=_list([_failure(failure) for failure in verdict.failures], "failures"),
        notes=_list([escape(note) for note in assessment.notes], "note"),
        facts=_facts(run, experiment, assessment.flight),
        replay=replay,
        polar=polar,
        still=_still(still) if still else "",
        figures="\n".join(_figure(n, picture) for n, picture in enumerate(pictures, start=1)),
        numbers=_table_rows(assessment.numbers),
        repeat=escape(REPEAT[run.mode == "virtual"]),
        command=f"cloudrc run config.yaml --mode {escape(run.mode)}",
        hash=f"<p>SHA-256 of all records: <code>{escape(digest)}</code></p>" if digest else "",
        config=escape(dump(experiment)),
        environment=escape(json.dumps(environment, indent=2)),
    )


def _facts(run: Run, experiment: ResolvedExperiment, flight: Flight) -> str:
    cloud = experiment.cloud
    flown = wall_time(flight.recording.metadata, flight.start_ns or 0)
    facts = {
        "Experiment": experiment.name,
        "Mode": run.mode,
        "Seed": str(experiment.seed),
        "Link profile": f"{experiment.link.profile} ({run.shaper})",
        "Datagram order": f"{experiment.tunnel.order} wins",
        "Delay estimator": cloud.estimator.name,
        "Predictor": cloud.predictor.name,
        "Controller": cloud.controller.name,
        # A flight in virtual time has no date.
        "Flown" if flown else "Report written": f"{flown or datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
    }
    return _pairs(facts)


def _pairs(pairs: Mapping[str, str]) -> str:
    return "\n".join(
        f"<div><dt>{name}</dt><dd>{escape(value)}</dd></div>" for name, value in pairs.items()
    )


def _failure(failure: FlightFailure) -> str:
    text = escape(failure.text)
    if failure.time is not None:
        text += f", at {failure.time:.2f} s"
    if failure.place is not None:
        text += ", x {:.2f}, y {:.2f}, z {:.2f} m".format(*failure.place)
    return f"{text} <code>{escape(failure.code)}</code>"


def _list(items: Sequence[str], name: str) -> str:
    rows = "".join(f"<li>{item}</li>" for item in items)
    return f'<ul class="{name}">{rows}</ul>' if items else ""


def _still(picture: Picture) -> str:
    source = f"data:image/png;base64,{b64encode(picture.files['png']).decode()}"
    return (
        f'<figure id="still"><img src="{source}" alt="{escape(picture.alt)}">\n'
        f"<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


def _figure(number: int, picture: Picture) -> str:
    source = f"data:image/svg+xml;base64,{b64encode(picture.files['svg']).decode()}"
    size = f' style="max-width: {picture.width:g}in"' if picture.width < PAGE else ""
    panels = "".join(
        f'<span style="left:{left:.2%};bottom:{bottom:.2%};width:{width:.2%};height:{height:.2%}">'
        "</span>"
        for left, bottom, width, height in picture.over_time
    )
    return (
        f'<figure id="{picture.name}"><div class="plot"{size}><img src="{source}"'
        f' alt="{escape(picture.alt)}">{panels}</div>\n'
        f"<figcaption><b>Fig. {number}.</b> {escape(picture.caption)}</figcaption></figure>"
    )


def _table_rows(numbers: Mapping[str, Number]) -> str:
    groups = defaultdict[str, str](str)  # title -> its rows
    shipped = {metric.name: metric.group for metric in in_groups()}
    for name, title in (
        shipped | dict.fromkeys(sorted(numbers.keys() - shipped), "Others")
    ).items():
        if name in numbers:
            groups[title] += _row(name, numbers[name])
    return "\n".join(
        f'<tbody>\n<tr><th scope="rowgroup" colspan="4">{escape(title)}</th></tr>\n{rows}</tbody>'
        for title, rows in groups.items()
    )


def _row(name: str, number: Number) -> str:
    digits, unit = readable(name, number)
    return (
        f"<tr><td><code>{escape(name)}</code></td>"
        f'<td class="value">{escape(digits)}</td><td class="unit">{escape(unit)}</td>'
        f"<td>{escape(number.meaning)}</td></tr>\n"
    )
