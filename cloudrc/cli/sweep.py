"""`cloudrc sweep`: fly a grid of settings with several seeds; write a row of numbers per flight."""

from __future__ import annotations

import argparse
import re
from pathlib import Path

from cloudrc.cli.cluster_flags import release_arguments
from cloudrc.cli.output import output_argument
from cloudrc.cli.parser import (
    COUNT_MAX,
    FLIGHTS_MAX,
    add_verbs,
    figure_arguments,
    read_count,
    whole_number,
)
from cloudrc.runs.interrupts import interrupt_on_signals

VERBS = {
    "run": "fly all points of a grid, or those that are missing in --out",
    "status": "count the rows and the successful flights of a sweep",
    "fly": "fly one row again with a recording and a report, and compare the hashes",
    "figure": "draw metrics and success over an axis, as PDF, PNG and SVG",
    "rows": "fly a file of flights and print the rows; the pods of --on kubernetes do this",
}
EPILOG = """\
examples:
  cloudrc sweep run grid.yaml
  cloudrc sweep run grid.yaml --out runs/mine    again: fly what is missing
  cloudrc sweep status runs/latest-sweep
  cloudrc sweep fly runs/latest-sweep 73434426a8081810
  cloudrc sweep figure runs/latest-sweep --x link.both.delay_ms
  cloudrc sweep run grid.yaml --on kubernetes --shards 8 -n lab

docs/sweeps.md describes the file of a sweep and the shards of a cluster."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    run, status, fly, figure, rows = add_verbs(parser, VERBS).values()
    run.add_argument("file", type=Path, metavar="FILE", help="file of the sweep (.yaml)")
    about = "folder of the sweep (default: a new one in runs/); if it has rows, fly the others"
    run.add_argument("--out", type=Path, metavar="DIR", help=about)
    about = "number of parallel processes (default: one per usable core)"
    run.add_argument("--jobs", type=read_count, default=COUNT_MAX, metavar="N", help=about)
    about = f"refuse a sweep with more flights (default: {FLIGHTS_MAX:,})"
    limit = whole_number(1, 10**9)
    run.add_argument("--max-flights", type=limit, default=FLIGHTS_MAX, metavar="N", help=about)
    about = "fly the failed or all flights again with a recording, into DIR/KEY"
    run.add_argument("--record", choices=("failed", "all"), help=about)
    about = "fly only part I of N, counted from 1"
    run.add_argument("--shard", type=_shard, metavar="I/N", help=about)
    rows.add_argument("file", type=Path, metavar="FILE", help="file of flights, of a Job")
    rows.add_argument("--shard", type=_shard, default=(1, 1), metavar="I/N", help=about)
    add = release_arguments(run)
    about = "fly in the pods of a Job instead of on this machine"
    add("--on", choices=("kubernetes",), help=about)
    add("--shards", type=read_count, default=8, metavar="N", help="number of pods (default: 8)")
    about = "image of the pods (default: cloudrc/world of this version, as the chart names it)"
    add("--image", metavar="IMAGE", help=about)
    about = "CPU request of a pod, such as 500m or 2 (default: 1)"
    add("--cpu", type=_cpu, default="1", metavar="CPU", help=about)
    add("--queue", metavar="NAME", help="queue of Kueue that admits the Job")
    for each in (status, fly, figure):
        each.add_argument("folder", type=Path, metavar="DIR", help="folder of a sweep")
    fly.add_argument("key", metavar="KEY", help="key of the row, or its first digits")
    output_argument(run)
    output_argument(status)
    add = figure.add_argument
    about = "metric to draw; repeatable (default: three that matter first)"
    add("--number", action="append", default=[], metavar="NAME", help=about)
    about = "axis of the sweep along x (default: the first one with numbers)"
    add("--x", metavar="AXIS", help=about)
    about = "axis with one line per value (default: the first with names, else the next one)"
    add("--by", metavar="AXIS", help=about)
    about = "path of the files, with or without a suffix (default: DIR/figure)"
    add("--out", type=Path, metavar="FILE", help=about)
    figure_arguments(figure, 3.5)


def _cpu(text: str) -> str:
    """Check a CPU request as Kubernetes writes it: a number of cores, or of thousandths."""
    if re.fullmatch(r"[0-9]+m|[0-9]+(\.[0-9]{1,3})?", text) is None:
        about = "give a number of cores, such as 2 or 0.5, or of thousandths, such as 500m"
        raise argparse.ArgumentTypeError(f"'{text}' is no CPU request; {about}")
    return text


def _shard(text: str) -> tuple[int, int]:
    """Parse "I/N", shard I of N shards, counted from 1."""
    index, _, count = text.partition("/")
    if index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count):
        return int(index), int(count)
    raise argparse.ArgumentTypeError(f"'{text}' is not I/N with I from 1 to N")


def execute(options: argparse.Namespace) -> int:
    """Run the chosen verb; return the exit code."""
    # First: until then, the first process of a container ignores signals.
    interrupt_on_signals()
    from cloudrc.cli import sweep_run as actions

    functions = (actions.run, actions.print_status, actions.fly_again, actions.draw_figure,
                 actions.print_rows)  # fmt: skip
    return dict(zip(VERBS, functions, strict=True))[options.verb](options)
