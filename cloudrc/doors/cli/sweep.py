# SPDX-License-Identifier: Apache-2.0

"""`cloudrc sweep`: fly a grid of settings with several seeds; write a row of numbers per flight."""

from __future__ import annotations

import re
from argparse import ArgumentTypeError
from pathlib import Path

from cloudrc.doors.cli.output import output_argument
from cloudrc.doors.cli.parser import (
    COUNT_MAX,
    FLIGHTS_MAX,
    Options,
    Parser,
    add_verbs,
    figure_arguments,
    read_count,
    whole_number,
)
from cloudrc.doors.cli.where import release_arguments

VERBS = {
    "run": "fly all points of a grid, or those that are missing in --out",
    "attach": "take the rows of a sweep on Kubernetes whose 'sweep run' has ended",
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
  cloudrc sweep run grid.yaml --on kubernetes --shards 8 -n lab --claim rows
  cloudrc sweep attach runs/latest-sweep         its rows, after it was killed

docs/sweeps.md describes the file of a sweep and the shards of a cluster."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    run, attach, status, fly, figure, rows = add_verbs(parser, VERBS).values()
    run.add_argument("file", type=Path, metavar="FILE", help="file of the sweep (.yaml)")
    about = "folder of the sweep (default: a new one in runs/); if it has rows, fly the others"
    run.add_argument("--out", type=Path, metavar="DIR", help=about)
    about = "number of parallel processes (default: one per usable core)"
    run.add_argument("--jobs", type=read_count, default=COUNT_MAX, metavar="N", help=about)
    about = f"refuse a sweep with more flights (default: {FLIGHTS_MAX:,})"
    run.add_argument(
        "--max-flights", type=whole_number(1, 10**9), default=FLIGHTS_MAX, metavar="N", help=about
    )
    about = "fly the failed or all flights again with a recording, into DIR/KEY"
    run.add_argument("--record", choices=("failed", "all"), help=about)
    about = "fly only part I of N, counted from 1"
    run.add_argument("--shard", type=shard, metavar="I/N", help=about)
    rows.add_argument("file", type=Path, metavar="FILE", help="file of flights, of a Job")
    rows.add_argument("--shard", type=shard, default=(1, 1), metavar="I/N", help=about)
    about = "folder, or s3://BUCKET/FOLDER, that keeps the rows; those in it are not flown again"
    rows.add_argument("--out", metavar="PLACE", help=about)
    _pod_arguments(run)
    for each in (attach, status, fly, figure):
        each.add_argument("folder", type=Path, metavar="DIR", help="folder of a sweep")
    fly.add_argument("key", metavar="KEY", help="key of the row, or its first digits")
    for each in (run, attach, status):
        output_argument(each)
    about = "metric to draw; repeatable (default: three that matter first)"
    figure.add_argument("--metric", action="append", default=[], metavar="NAME", help=about)
    about = "axis of the sweep along x (default: the first one with numbers)"
    figure.add_argument("--x", metavar="AXIS", help=about)
    about = "axis with one line per value (default: the first with names, else the next one)"
    figure.add_argument("--by", metavar="AXIS", help=about)
    about = "path of the files, with or without a suffix (default: DIR/figure)"
    figure.add_argument("--out", type=Path, metavar="FILE", help=about)
    figure_arguments(figure, 3.5)


def _pod_arguments(run: Parser) -> None:
    """Declare the flags of `--on kubernetes`."""
    group = release_arguments(run)
    group.add_argument(
        "--on", choices=("kubernetes",), help="fly in the pods of a Job instead of on this machine"
    )
    about = "number of pods, at most one per flight (default: 8)"
    group.add_argument("--shards", type=read_count, default=8, metavar="N", help=about)
    group.add_argument(
        "--parallelism", type=read_count, metavar="N", help="number of pods at once (default: all)"
    )
    group.add_argument(
        "--claim", metavar="NAME", help="PersistentVolumeClaim in which the pods keep their rows"
    )
    about = "bucket, or folder in it, in which the pods keep their rows"
    group.add_argument("--bucket", type=bucket, metavar="s3://NAME", help=about)
    about = "image of the pods (default: that of this version, as the chart names it)"
    group.add_argument("--image", metavar="IMAGE", help=about)
    about = "CPU request of a pod, such as 500m or 2 (default: 1)"
    group.add_argument("--cpu", default="1", metavar="CPU", help=about)
    group.add_argument("--cpu-limit", metavar="CPU", help="CPU limit of a pod (default: none)")
    about = "memory of a pod, such as 1Gi (default: requests 256Mi, takes at most 512Mi)"
    group.add_argument("--memory", metavar="SIZE", help=about)
    group.add_argument("--queue", metavar="NAME", help="queue of Kueue that admits the Job")
    about = "field of the Job, its pod or container, such as nodeSelector.disk=ssd; repeatable"
    group.add_argument("--set-job", action="append", default=[], metavar="KEY=VALUE", help=about)


def shard(text: str) -> tuple[int, int]:
    """Parse "I/N", shard I of N shards, counted from 1."""
    found = re.fullmatch(r"(\d+)/(\d+)", text, re.ASCII)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise ArgumentTypeError(f"{text!r} is not I/N with I from 1 to N")
    return int(found[1]), int(found[2])


def bucket(text: str) -> str:
    """Check the address of a bucket, or of a folder in it."""
    if not re.fullmatch(r"s3://[^/]+(/.*)?", text):
        raise ArgumentTypeError(f"{text!r} is not s3://BUCKET or s3://BUCKET/FOLDER")
    return text


def execute(options: Options) -> int:
    """Run the chosen verb; return the exit code."""
    from cloudrc.doors.cli import sweep_run

    code: int = getattr(sweep_run, options.verb)(options)
    return code
