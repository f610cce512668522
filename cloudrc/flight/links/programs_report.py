# SPDX-License-Identifier: Apache-2.0

"""Report on a link of other programs: the verdict on each direction, and a recording."""

from __future__ import annotations

from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.files import at_place, write_json
from cloudrc.flight.links.verify import Report, make_report
from cloudrc.link.carry.log import LOGGED_MAX
from cloudrc.link.verify.causes import LATE, Findings, ShaperFacts, in_unit
from cloudrc.link.verify.packets import judge_packets, recording

if TYPE_CHECKING:
    from cloudrc.flight.links.carrier import LiveLink
    from cloudrc.flight.links.programs import ExecOutcome, ExecSettings

WAITED = 0.01
"""Share of packets that were read behind a full batch, above which the relay lacks CPU time."""


def make_exec_report(settings: ExecSettings, outcome: ExecOutcome, link: LiveLink) -> Report:
    """Judge the link between two programs; return the content of link.json."""
    return {
        **make_link_report(link),
        "programs": {
            name: {"command": getattr(settings, name), "exit_code": outcome.codes.get(name)}
            for name in ("server", "client")
        },
        "interrupted": outcome.interrupted,
    }


def make_link_report(link: LiveLink) -> Report:
    """Judge the directions of a link."""
    counts = link.counts()
    p50, p99 = (counts.get(f"release_error_{one}_ns", 0) * 1e-9 for one in ("p50", "p99"))
    notes = [f"packets left {in_unit(p50, 's')} (median) or {in_unit(p99, 's')} (99 %) late"]
    findings, asked = dict[str, Findings](), dict[str, dict[str, float]]()
    for name, way in link.ways.items():
        starved, first = _starved(link, name, p99), link.period(name).first
        if starved:
            notes.append(f"{name}: the relay lacks CPU time: {starved}")
        judged = judge_packets(way.log, link.period(name))
        packets = f"{way.received - first} packets" + ", since the last change" * (first > 0)
        facts = ShaperFacts(shaper="relay", starved=starved)
        findings[name] = Findings([row for _, row in judged], facts, packets)
        asked[name] = {row.name: value for value, row in judged if not isnan(value)}
    report = make_report(link.cause, findings)
    for name, direction in report["directions"].items():
        for row in direction["rows"]:
            row["applied"] = row.pop("asked")
            if row["name"] in asked[name]:
                row["asked"] = asked[name][row["name"]]
    report["notes"] += notes
    states = {name: asdict(link.states[name]) for name in link.ways}
    return {"schemaVersion": 1, **report, "seed": link.seed, "counts": counts, "states": states}


def _starved(link: LiveLink, name: str, late: float) -> str:
    """Return signs that the relay lacks CPU time; `late` is the 99 % quantile of lateness [s]."""
    way, unread = link.ways[name], link.unread.get(name, 0)
    signs = (
        (late > LATE, f"1 % of packets left later than {in_unit(late, 's')}"),
        (way.waited > WAITED * way.received, f"{way.waited} packets waited to be read"),
        (unread > 0, f"{unread} packets not read in time"),
    )
    return ", ".join(text for holds, text in signs if holds)


def write_report(folder: Path, report: Report, link: LiveLink) -> None:
    """Write link.json, and a recording of the packets of each direction."""
    write_json(folder / "link.json", report)
    for name, way in link.ways.items():
        path = folder / f"{name}.csv"
        with at_place(path), path.open("w", encoding="utf-8") as file:
            if way.received > LOGGED_MAX:
                file.write(f"# the first {LOGGED_MAX} of {way.received} packets\n")
            origin_ns = way.log.sent[0] if len(way.log) else 0
            file.writelines(f"{line}\n" for line in recording(way.log, origin_ns))
