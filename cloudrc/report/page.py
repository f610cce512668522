"""The page: verdict, numbers and figures go in; one HTML file that needs nothing else comes out.

Pictures are inside the page, fonts are the reader's own: it opens from a disk, makes no request,
and prints.
"""

from __future__ import annotations

import json
import re
import shlex
from base64 import b64encode
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Any

from cloudrc import __version__
from cloudrc.config.load import ResolvedExperiment, dump
from cloudrc.metrics import Flight, Number
from cloudrc.report import numbers as table
from cloudrc.report import prose
from cloudrc.report.document import Run
from cloudrc.report.verdict import Failure, Verdict

if TYPE_CHECKING:
    from cloudrc.report.figures import Picture

_UNIT = re.compile(r"(\d) (s|m|mm|ms|N|m/s)\b")
"""A number and its unit: the line may not break between them."""
ACCENTS = {
    "success": "#00694b",
    "failure": "#a33a00",
    "invalid": "#7a5200",
    "interrupted": "#7a5200",
}


def render(
    run: Run,
    experiment: ResolvedExperiment,
    flight: Flight,
    verdict: Verdict,
    numbers: Mapping[str, Number],
    notes: Sequence[str],
    pictures: Sequence[Picture],
    environment: Mapping[str, Any],
) -> str:
    """Fill in the page.

    Args:
        run: What the recording does not say.
        experiment: That was flown.
        flight: As recorded.
        verdict: Of it.
        numbers: Measured.
        notes: What a reader should know, a sentence each.
        pictures: In the order of the page.
        environment: What environment.json says.
    """
    again, command = _again(run)
    digest = run.records_sha256
    return Template(files(__package__).joinpath("page.html").read_text("utf-8")).substitute(
        version=escape(__version__),
        title=escape(f"{experiment.name}: {verdict.outcome}"),
        accent=ACCENTS[verdict.outcome],
        kicker=escape(
            f"cloudrc run report · {experiment.name} · {run.mode} · seed {experiment.seed}"
        ),
        headline=escape(prose.headline(verdict)),
        summary=_UNIT.sub("\\1\u00a0\\2", escape(prose.summary(flight, numbers))),
        failures=_list([_failure(failure) for failure in verdict.failures], "failures"),
        notes=_list([escape(note) for note in notes], "note"),
        facts=_facts(run, experiment),
        figures="\n".join(_figure(n, picture) for n, picture in enumerate(pictures, start=1)),
        numbers=table.rows(numbers),
        again=escape(again),
        command=escape(command),
        hash=f"<p>SHA-256 of all records: <code>{escape(digest)}</code></p>" if digest else "",
        config=escape(dump(experiment)),
        environment=escape(json.dumps(environment, indent=2)),
    )


def _again(run: Run) -> tuple[str, str]:
    """Say how to fly the same again, and how alike it will be."""
    command = shlex.join(["cloudrc", "run", "config.yaml", "--mode", run.mode])
    if run.mode == "virtual":
        return "In this folder; the same records come out, bit by bit:", command
    return (
        "In this folder. Chance on the link is drawn from the same seed; the machine's own timing "
        "differs from run to run, so the numbers agree but not to the last digit:"
    ), command


def _facts(run: Run, experiment: ResolvedExperiment) -> str:
    cloud = experiment.cloud
    pairs = {
        "Experiment": experiment.name,
        "Mode": run.mode,
        "Seed": str(experiment.seed),
        "Link profile": f"{experiment.link.profile}, by {run.shaper}",
        "Late datagrams": f"{experiment.tunnel.order} wins",
        "Delay estimator": cloud.estimator.name,
        "Predictor": cloud.predictor.name,
        "Controller": cloud.controller.name,
    }
    return "\n".join(
        f"<div><dt>{escape(name)}</dt><dd>{escape(value)}</dd></div>"
        for name, value in pairs.items()
    )


def _failure(failure: Failure) -> str:
    text = escape(failure.text)
    if failure.time is not None:
        text += f", at {failure.time:.2f} s"
    if failure.place is not None:
        text += ", x {:.2f}, y {:.2f}, z {:.2f} m".format(*failure.place)
    return f"{text} <code>{escape(failure.code)}</code>"


def _list(items: Sequence[str], name: str) -> str:
    if not items:
        return ""
    rows = "".join(f"<li>{item}</li>" for item in items)
    return f'<ul class="{name}">{rows}</ul>'


def _figure(number: int, picture: Picture) -> str:
    source = f"data:image/svg+xml;base64,{b64encode(picture.svg).decode()}"
    return (
        f'<figure id="{picture.name}"><img src="{source}" alt="{escape(picture.alt)}">\n'
        f"<figcaption><b>Fig. {number}.</b> {escape(picture.caption)}</figcaption></figure>"
    )
