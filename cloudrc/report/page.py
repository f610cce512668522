"""Make the page report.html: verdict, a summary in words, numbers and figures in one file.

The page embeds its pictures, uses the reader's fonts and sends no request to the network.
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
from cloudrc.metrics.verdict import Failure, Verdict
from cloudrc.report.document import Run
from cloudrc.report.numbers import table_rows

if TYPE_CHECKING:
    from cloudrc.report.figures import Picture


HEADLINES = {
    "success": "The mission succeeded.",
    "failure": "The mission failed.",
    "invalid": "The run is invalid: it did not keep real time.",
    "interrupted": "The run was interrupted.",
}


def summary(flight: Flight, numbers: Mapping[str, Number]) -> str:
    """Summarize the flight in a few sentences, with the known numbers."""
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
    duration = f" in {known['duration']:.1f} s" if "duration" in known else ""
    distance = f" and flew {known['distance_flown']:.1f} m" if "distance_flown" in known else ""
    count = flight.waypoints
    if reached == str(count):
        goal = "its waypoint" if count == 1 else f"all {count} waypoints"
    else:
        goal = f"{reached} of {count} waypoints"
    return f"The drone reached {goal}{duration}{distance}."


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
    return f"It flew through {pipes} and never came closer than {nearest:.0f} mm to a wall."


def _contact(flight: Flight, known: Mapping[str, float]) -> str:
    if "contact_time" not in known or "tip_speed" not in known:
        return "It never touched the board." if flight.criteria.contact else ""
    text = (
        f"Its arm touched the board after {known['contact_time']:.1f} s "
        f"at {known['tip_speed']:.2f} m/s"
    )
    if "steady_contact_force" in known:
        text += f" and then pressed against it with {known['steady_contact_force']:.2f} N"
    return text + "."


def _link(known: Mapping[str, float]) -> str:
    if "prediction_error_rms" not in known or "rtt_mean" not in known:
        return ""
    return (
        f"The mean round trip was {known['rtt_mean'] * 1e3:.0f} ms. The remote controller "
        f"predicted the robot's position with an error of "
        f"{known['prediction_error_rms'] * 1e3:.0f} mm (RMS)."
    )


def _guard(known: Mapping[str, float]) -> str:
    if "hold_count" not in known:
        return ""
    count = known["hold_count"]
    if not count:
        return "The guard on board never took over."
    times = "once" if count == 1 else f"{count:.0f} times"
    return f"The guard on board took over {times}, for {known.get('hold_time', 0):.1f} s in total."


_UNIT = re.compile(r"(\d) (s|m|mm|ms|N|m/s)\b")
"""Pattern of a number and its unit; no line may break between number and unit."""
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
        run: Facts about the run that are not in its recording.
        experiment: The experiment.
        flight: The recorded flight.
        verdict: The verdict on the run.
        numbers: Measured numbers.
        notes: Notes for the reader, a sentence each.
        pictures: Figures in the order of the page.
        environment: Content of environment.json.
    """
    repeat, command = _repeat(run)
    digest = run.records_sha256
    return Template(files(__package__).joinpath("page.html").read_text("utf-8")).substitute(
        version=escape(__version__),
        title=escape(f"{experiment.name}: {verdict.outcome}"),
        accent=ACCENTS[verdict.outcome],
        kicker=escape(
            f"cloudrc run report · {experiment.name} · {run.mode} · seed {experiment.seed}"
        ),
        headline=escape(HEADLINES[verdict.outcome]),
        summary=_UNIT.sub("\\1\u00a0\\2", escape(summary(flight, numbers))),
        failures=_list([_failure(failure) for failure in verdict.failures], "failures"),
        notes=_list([escape(note) for note in notes], "note"),
        facts=_facts(run, experiment),
        figures="\n".join(_figure(n, picture) for n, picture in enumerate(pictures, start=1)),
        numbers=table_rows(numbers),
        repeat=escape(repeat),
        command=escape(command),
        hash=f"<p>SHA-256 of all records: <code>{escape(digest)}</code></p>" if digest else "",
        config=escape(dump(experiment)),
        environment=escape(json.dumps(environment, indent=2)),
    )


def _repeat(run: Run) -> tuple[str, str]:
    """Return an instruction and a command with which the reader can repeat the run."""
    command = shlex.join(["cloudrc", "run", "config.yaml", "--mode", run.mode])
    if run.mode == "virtual":
        return "Run this in the folder of the report; the records will be identical:", command
    return (
        "Run this in the folder of the report. The random numbers of the link come from the same "
        "seed. The timing of the machine differs between runs, so the numbers will be close but "
        "not identical:"
    ), command


def _facts(run: Run, experiment: ResolvedExperiment) -> str:
    cloud = experiment.cloud
    pairs = {
        "Experiment": experiment.name,
        "Mode": run.mode,
        "Seed": str(experiment.seed),
        "Link profile": f"{experiment.link.profile} ({run.shaper})",
        "Datagram order": f"{experiment.tunnel.order} wins",
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
