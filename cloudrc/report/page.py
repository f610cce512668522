"""The page: verdict, numbers and figures go in; one HTML file that needs nothing else comes out.

Pictures are inside the page, fonts are the reader's own: it opens from a disk, makes no request,
and prints.

The verdict in words: what happened on this flight, for somebody who reads only one paragraph.
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
from cloudrc.report.document import Failure, Run, Verdict

if TYPE_CHECKING:
    from cloudrc.report.figures import Picture


HEADLINES = {
    "success": "The mission succeeded.",
    "failure": "The mission failed.",
    "invalid": "The run is invalid: it did not keep real time.",
    "interrupted": "The run was interrupted.",
}


def headline(verdict: Verdict) -> str:
    """Say in one short sentence what became of the run."""
    return HEADLINES[verdict.outcome]


def summary(flight: Flight, numbers: Mapping[str, Number]) -> str:
    """Say in a few sentences what happened, with what is known of it."""
    if flight.start_ns is None:
        return "The robot never left the ground."
    known = {name: number.value for name, number in numbers.items()}
    parts = [
        _waypoints(flight, known),
        _pipes(flight, known),
        _contact(flight, known),
        _link(known),
        _guard(known),
    ]
    return " ".join(part for part in parts if part)


def _waypoints(flight: Flight, known: Mapping[str, float]) -> str:
    reached = f"{known.get('waypoints_reached', 0):.0f}"
    took = f" in {known['duration']:.1f} s" if "duration" in known else ""
    far = f", {known['distance_flown']:.1f} m" if "distance_flown" in known else ""
    count = flight.waypoints
    if reached == str(count):
        goal = "its waypoint" if count == 1 else f"all {count} waypoints"
    else:
        goal = f"{reached} of {count} waypoints"
    return f"The drone reached {goal}{took}{far}."


def _pipes(flight: Flight, known: Mapping[str, float]) -> str:
    flown = flight.pipes_flown
    if not flown or "min_clearance" not in known:
        return ""
    pipes = "one pipe" if flown == 1 else f"{flown} pipes"
    touched = known.get("pipe_contacts", 0)
    if touched:
        times = "once" if touched == 1 else f"{touched:.0f} times"
        return f"It flew through {pipes} and touched a wall {times}."
    nearest = known["min_clearance"] * 1e3
    return f"It flew through {pipes}, never nearer than {nearest:.0f} mm to a wall."


def _contact(flight: Flight, known: Mapping[str, float]) -> str:
    if "contact_time" not in known or "tip_speed" not in known:
        return "It never touched the board." if flight.criteria.contact else ""
    text = (
        f"Its arm touched the board after {known['contact_time']:.1f} s "
        f"at {known['tip_speed']:.2f} m/s"
    )
    if "steady_contact_force" in known:
        text += f" and then pressed on it with {known['steady_contact_force']:.2f} N"
    return text + "."


def _link(known: Mapping[str, float]) -> str:
    if "prediction_error_rms" not in known or "rtt_mean" not in known:
        return ""
    return (
        f"The round trip took {known['rtt_mean'] * 1e3:.0f} ms on average; the remote controller "
        f"predicted where its commands would act to within "
        f"{known['prediction_error_rms'] * 1e3:.0f} mm (RMS)."
    )


def _guard(known: Mapping[str, float]) -> str:
    if "hold_count" not in known:
        return ""
    count = known["hold_count"]
    if not count:
        return "The guard on board never had to take over."
    times = "once" if count == 1 else f"{count:.0f} times"
    return f"The guard on board took over {times}, for {known.get('hold_time', 0):.1f} s in all."


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
        headline=escape(headline(verdict)),
        summary=_UNIT.sub("\\1\u00a0\\2", escape(summary(flight, numbers))),
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
