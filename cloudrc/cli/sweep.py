# SPDX-License-Identifier: Apache-2.0

"""`cloudrc sweep`: fly a grid of settings with several seeds; write a row of numbers per flight."""

from __future__ import annotations

import re
from argparse import ArgumentTypeError

from cloudrc.cli.output import output_argument
from cloudrc.cli.parser import (
    COUNT_MAX,
    FLIGHTS_MAX,
    Options,
    Parser,
    add_verbs,
    figure_arguments,
    flags,
    read_count,
    whole_number,
)
from cloudrc.cli.where import release_arguments

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
    add = flags(run)
    add("file", "FILE", "file of the sweep (.yaml)")
    about = "folder of the sweep (default: a new one in runs/); if it has rows, fly the others"
    add("--out", "DIR", about)
    about = "number of parallel processes (default: one per usable core)"
    add("--jobs", "N", about, COUNT_MAX, read_count)
    about = f"refuse a sweep with more flights (default: {FLIGHTS_MAX:,})"
    add("--max-flights", "N", about, FLIGHTS_MAX, whole_number(1, 10**9))
    about = "fly the failed or all flights again with a recording, into DIR/KEY"
    add("--record", None, about, choices=("failed", "all"))
    about = "fly only part I of N, counted from 1"
    add("--shard", "I/N", about, read=shard)
    flags(rows)("file", "FILE", "file of flights, of a Job")
    flags(rows)("--shard", "I/N", about, (1, 1), shard)
    about = "folder, or s3://BUCKET/FOLDER, that keeps the rows; those in it are not flown again"
    flags(rows)("--out", "PLACE", about)
    _pod_arguments(run)
    for each in (attach, status, fly, figure):
        flags(each)("folder", "DIR", "folder of a sweep")
    flags(fly)("key", "KEY", "key of the row, or its first digits")
    for each in (run, attach, status):
        output_argument(each)
    add = flags(figure)
    about = "metric to draw; repeatable (default: three that matter first)"
    add("--number", "NAME", about, many=True)
    add("--x", "AXIS", "axis of the sweep along x (default: the first one with numbers)")
    about = "axis with one line per value (default: the first with names, else the next one)"
    add("--by", "AXIS", about)
    add("--out", "FILE", "path of the files, with or without a suffix (default: DIR/figure)")
    figure_arguments(figure, 3.5)


def _pod_arguments(run: Parser) -> None:
    """Declare the flags of `--on kubernetes`."""
    add = release_arguments(run)
    about = "fly in the pods of a Job instead of on this machine"
    add("--on", None, about, choices=("kubernetes",))
    add("--shards", "N", "number of pods, at most one per flight (default: 8)", 8, read_count)
    add("--parallelism", "N", "number of pods at once (default: all)", None, read_count)
    add("--claim", "NAME", "PersistentVolumeClaim in which the pods keep their rows")
    about = "bucket, or folder in it, in which the pods keep their rows"
    add("--bucket", "s3://NAME", about, None, bucket)
    about = "image of the pods (default: cloudrc/world of this version, as the chart names it)"
    add("--image", "IMAGE", about)
    add("--cpu", "CPU", "CPU request of a pod, such as 500m or 2 (default: 1)", "1")
    add("--cpu-limit", "CPU", "CPU limit of a pod (default: none)")
    about = "memory of a pod, such as 1Gi (default: requests 256Mi, takes at most 512Mi)"
    add("--memory", "SIZE", about)
    add("--queue", "NAME", "queue of Kueue that admits the Job")
    about = "field of the Job, its pod or container, such as nodeSelector.disk=ssd; repeatable"
    add("--set-job", "KEY=VALUE", about)


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
    from cloudrc.cli import sweep_run

    code: int = getattr(sweep_run, options.verb)(options)
    return code
