"""Run `cloudrc link verify`: compare a link with its profile, by probes or in flight."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from math import nan
from typing import Any

from cloudrc.cli.cluster_flags import flown_release
from cloudrc.cli.output import paint, print_line, print_result
from cloudrc.errors import BadInputError
from cloudrc.link.verify.causes import in_unit
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.runs.verify import (
    KEYS,
    NOT_JUDGED,
    RELEASE_TIMEOUT,
    Report,
    check_seconds,
    forwarded_pods,
    pods_at,
    verify,
    verify_release,
)
from cloudrc.text import escape, table

MEANINGS = {
    "not believed": ("red", "does not match its profile"),
    "undecided": ("yellow", "needs more --seconds, or cannot be judged: see the notes"),
    "believed": ("green", "matches its profile"),
}
"""Verdict on a link -> its colour, and what it means."""


def execute(options: argparse.Namespace) -> int:
    """Measure the link and print the verdict; return 0 if the link matches its profile, else 1."""
    interrupt_on_signals()  # on a signal, remove namespaces and processes
    report = _verify(options)
    print_result(options.output, report, as_text(report))
    return 0 if report["verdict"] == "believed" else 1


def _verify(options: argparse.Namespace) -> Report:
    limit = check_seconds(options.seconds) or RELEASE_TIMEOUT
    if options.ends:
        hosts = options.ends.split(",")
        if len(hosts) != 2 or not all(hosts):
            raise BadInputError(f"--ends {options.ends}: give two hosts, WORLD,CLOUD")
        return verify_release(options.release or "cloudrc", pods_at(hosts), limit)
    if options.mode == "cluster":
        release = flown_release(options)
        with forwarded_pods(release) as pods:
            return verify_release(release.name, pods, limit)
    return verify(
        options.target,
        options.settings,
        shaper=options.shaper,
        seconds=options.seconds,
        tell=lambda text: print_line(text, sys.stderr),
    )


def as_text(report: Report) -> str:
    """Format a report: a table per direction, notes, causes and, in the last line, the verdict."""
    lines = [escape(f"{report['link']}: {report['shaper']}")]
    for way, found in report["directions"].items():
        rows = [[way, "asked", "measured", "allowed", "verdict"], *map(_cells, found["rows"])]
        lines += ["", escape(f"{way}: {found['probes']}"), table(rows, [1, 2, 3])]
    causes = [f"  {one['way']}: {one['text']}  [{one['code']}]" for one in report["causes"]]
    lines += ["", *map(escape, [*report["notes"], *causes])]
    partly = any(NOT_JUDGED in note for note in report["notes"]) and report["verdict"] == "believed"
    colour, text = MEANINGS[report["verdict"]]
    text += f", except what is {NOT_JUDGED} (above)" * partly
    return "\n".join([*lines, paint(f"{report['verdict'].upper()}: the link {text}", colour)])


def _cells(row: Mapping[str, Any]) -> list[str]:
    values = (row.get(key, nan) for key in KEYS)
    asked, measured, low, high = (in_unit(value, row["unit"]) for value in values)
    return [f"  {row['name']}", asked, measured, f"{low} .. {high}", row["verdict"]]
