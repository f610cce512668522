# SPDX-License-Identifier: Apache-2.0

"""Compare a link with its profile: start it on this machine, and measure it with probes.

Another module, `cluster.verify`, asks a release in flight.
"""

from __future__ import annotations

import json
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from math import inf, nan
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc.base.outside.prometheus import read_metrics
from cloudrc.base.outside.refusal import check_names
from cloudrc.base.text import Paint, escape, plain, table
from cloudrc.config import shipped
from cloudrc.config.load import read_experiment
from cloudrc.config.profile import Profile
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.config.schema import Experiment
from cloudrc.flight.links.under_test import LOOPBACK, WAYS, Way, inside, measure, run_link
from cloudrc.flight.pod.netem_tools import run_tool
from cloudrc.link.netem import check, find_netems
from cloudrc.link.state import STATE_FILE
from cloudrc.link.traces import link_profile
from cloudrc.link.verify import DEFAULT, verdict_of
from cloudrc.link.verify.causes import Findings, find_causes, in_unit, read_evidence
from cloudrc.link.verify.judge import Flow, Judgement, Measurement, look_twice
from cloudrc.link.verify.probe import PROBE, plan_probes
from cloudrc.wire.tunnel.codec import SIZES, TELEMETRY_SIZES, Kind

COUNTS_WAIT = 1.3  # after the last probe: processes update their counts once a second [s]
HTTP_TIMEOUT = 3.0  # limit of a request [s]
NO_PROXY = urllib.request.build_opener(urllib.request.ProxyHandler({}))
"""Opens URLs directly, even if environment variables name a proxy."""
NOT_JUDGED = "NOT JUDGED"  # in a note about a quantity that could not be verified
OF_PROGRAMS = "send more, or run longer"
"""How the link of a user's programs gets more packets."""
COLUMNS = ("asked", "applied", "measured")
"""Values of a row in columns of their own; "applied" is what a relay has computed."""
VERDICTS = {"off": "not believed", "open": "undecided", "ok": "believed"}
"""Worst verdict on any quantity of the link -> verdict on the whole link."""
MEANINGS = {
    "not believed": ("red", "NOT VERIFIED", "does not match its profile"),
    "undecided": ("yellow", "UNDECIDED", "needs more packets"),
    "believed": ("green", "VERIFIED", "matches its profile"),
}
"""Verdict on a link, as files have it -> its colour, its word, and what it means."""
Report: TypeAlias = dict[str, Any]


def find_experiment(target: str, settings: Sequence[str]) -> ResolvedExperiment:
    """Read the experiment `target`; for a link profile, use it in the default experiment."""
    experiments, profiles = shipped.names("experiment"), shipped.names("profile")
    is_profile = target not in experiments
    if shipped.is_path(target):
        keys = set(shipped.read("profile", target, Path.cwd()).tree)
        is_profile = keys.isdisjoint(Experiment.model_fields.keys() - Profile.model_fields.keys())
        target = str(Path.cwd() / target)
    else:
        check_names("profile or experiment", [target], [*profiles, *experiments])
    if not is_profile:
        return read_experiment(target, settings)
    return read_experiment(DEFAULT, [f"link.profile={target}", *settings])


def verify(
    target: str = DEFAULT,
    settings: Sequence[str] = (),
    *,
    shaper: str = "relay",
    seconds: float | None = None,
) -> Report:
    """Send probes over a link that this function starts, and judge the link.

    If a measured quantity gets the verdict "off", repeat the measurement once.

    Args:
        target: Name or file of an experiment or a link profile.
        settings: Changes of the experiment: KEY=VALUE.
        shaper: "relay", or "netem", which needs root.
        seconds: Time to send probes [s]; None: as long as needed.
    """
    experiment = find_experiment(target, settings)
    plans, found = make_plans(experiment, seconds, shaper), dict[str, Findings]()
    for _ in range(2):
        with run_link(experiment, shaper) as ways:
            now = probe_link(ways, plans)
        rows = {way: look_twice(found.get(way, now[way]).rows, now[way].rows) for way in now}
        found = {way: now[way]._replace(rows=rows[way]) for way in now}
        if "off" not in {verdict_of(one.rows) for one in found.values()}:
            break
    return make_report(target, found)


def make_plans(
    experiment: ResolvedExperiment, seconds: float | None, shaper: str
) -> dict[str, Measurement]:
    """Plan probes in both directions for `seconds` [s] (None: as long as needed)."""
    plans = {}
    sensors = experiment.robot.sensors
    sizes = SIZES | {int(Kind.TELEMETRY): TELEMETRY_SIZES[len(sensors)]}
    for way, (_, _, kind) in WAYS.items():
        flow = Flow(experiment.seed, way == "uplink", PROBE, sizes[kind])
        profile = link_profile(getattr(experiment, way))
        if shaper == "netem":
            check(profile)
        plans[way] = plan_probes(profile, flow, seconds, drawn=shaper == "netem")
    return plans


def probe_link(ways: Mapping[str, Way], plans: Mapping[str, Measurement]) -> dict[str, Findings]:
    """Send all probes over a running link, and judge it; return direction -> findings."""
    streams, found = measure(ways, plans), {}
    time.sleep(COUNTS_WAIT)
    for name, way in ways.items():
        page = json.loads((way.folder / STATE_FILE).read_text())
        with inside(way.namespace):  # the process of the link may be stopped: ask the kernel
            page |= find_netems(run_tool, way.peer[0])
            metrics = read_metrics(fetch(f"http://{LOOPBACK}:{way.ports[1]}/metrics"))
        plan, count = plans[name], len(streams[name].sent)
        probes = f"{count} probes of {plan.flow.size} bytes"
        known = read_evidence(page, metrics, count)
        rows = plan.judge(streams[name])
        rows += plan.judge_phase(streams[name], late=bool(known.starved))
        found[name] = Findings(rows, known, probes)
    return found


def fetch(url: str) -> str:
    """Fetch a page, without a proxy; return "" if the server does not answer."""
    try:
        with NO_PROXY.open(url, timeout=HTTP_TIMEOUT) as page:
            return str(page.read().decode())
    except OSError:
        return ""


def _notes(way: str, rows: Sequence[Judgement]) -> Iterator[str]:
    judged = {row.name for row in rows if row.verdict != "told"}
    if not rows:
        yield f"{way}: no datagrams to measure; fly a mission first"
    elif judged and "mean" not in judged:
        yield f"{way}: one-way delays {NOT_JUDGED}: the ends do not share a clock"
    for row in rows:
        if row.verdict == "told":
            yield f"{way}: {row.name} {NOT_JUDGED}; docs/verify.md says why"


def make_report(title: str, findings: Mapping[str, Findings]) -> Report:
    """Make the report as values for JSON, in SI units; leave out unknown values.

    Losses and other shares are in [0, 1]. `title` names the link. `findings` has an entry per
    direction.
    """
    shapers = {one.evidence.shaper or "an unknown shaper" for one in findings.values()}
    verdicts = {verdict_of(one.rows) for one in findings.values()}
    return {
        "verdict": next(word for verdict, word in VERDICTS.items() if verdict in verdicts),
        "link": title,
        "shaper": f"shaped by {' and '.join(sorted(shapers))}",
        "causes": [cause._asdict() for cause in find_causes(findings)],
        "notes": [note for way, one in findings.items() for note in _notes(way, one.rows)],
        "directions": {
            way: {
                "probes": found.probes,
                "rows": [
                    {"name": row.name, "unit": row.unit} | _known(row._asdict())
                    for row in found.rows
                    if row.verdict != "told"
                ],
                "evidence": _known(found.evidence._asdict()),
            }
            for way, found in findings.items()
        },
    }


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    unknown = (None, "", (), inf, -inf)
    return {key: one for key, one in values.items() if one not in unknown and one == one}


def as_text(report: Report, paint: Paint = plain, more: str = "--seconds") -> str:
    """Format a report: a table per direction, notes, causes and, in the last line, the verdict.

    `more` says how the user gets more packets.
    """
    lines = [escape(f"{report['link']}: {report['shaper']}")]
    for way, found in report["directions"].items():
        shown = [key for key in COLUMNS if any(key in row for row in found["rows"])]
        heads = [way, *shown, "allowed", "verdict"]
        rows = [heads, *(_cells(row, shown) for row in found["rows"])]
        lines += ["", escape(f"{way}: {found['probes']}"), table(rows, [1, 2, 3])]
    causes = [f"  {one['way']}: {one['text']}  [{one['code']}]" for one in report["causes"]]
    lines += ["", *map(escape, [*report["notes"], *causes])]
    colour, word, text = MEANINGS[report["verdict"]]
    if report["verdict"] == "believed" and any(NOT_JUDGED in note for note in report["notes"]):
        text += f", except what is {NOT_JUDGED} (above)"
    if report["verdict"] == "undecided":
        judged = [(way, row) for way, one in report["directions"].items() for row in one["rows"]]
        names = [f"{row['name']} of the {way}" for way, row in judged if row["verdict"] == "open"]
        text += f" ({more})" + f" for {', '.join(names)}" * bool(names)
    return "\n".join([*lines, paint(f"{word}: the link {text}", colour)])


def _cells(row: Mapping[str, Any], shown: Sequence[str]) -> list[str]:
    values = {key: in_unit(row.get(key, nan), row["unit"]) for key in (*shown, "low", "high")}
    allowed = f"{values['low']} .. {values['high']}"
    return [f"  {row['name']}", *(values[key] for key in shown), allowed, row["verdict"]]
