"""`cloudrc sweep`: fly a grid of settings with several seeds; write a row of numbers per flight."""

from __future__ import annotations

import argparse
import os
import re
from pathlib import Path
from typing import NamedTuple

from cloudrc.cli.cluster_flags import release_arguments
from cloudrc.cli.output import output_argument
from cloudrc.cli.parser import COUNT_MAX, add_verbs, figure_arguments, read_count, whole_number
from cloudrc.renamed import new_name
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


class JobArray(NamedTuple):
    """The environment variables in which a scheduler numbers the jobs of an array ("": none)."""

    this: str  # number of this job
    all: str = ""  # number of all jobs
    first: str = ""  # number of the first job
    last: str = ""  # number of the last job
    begin: int = 1  # number of the first job, if no variable has it


LSF = JobArray("LSB_JOBINDEX")
ARRAYS = (
    JobArray(
        "SLURM_ARRAY_TASK_ID",
        "SLURM_ARRAY_TASK_COUNT",
        "SLURM_ARRAY_TASK_MIN",
        "SLURM_ARRAY_TASK_MAX",
        begin=0,
    ),
    JobArray("PBS_ARRAY_INDEX"),
    LSF,
    JobArray("JOB_COMPLETION_INDEX", "JOB_COMPLETIONS", begin=0),
)
"""The job arrays of Slurm, PBS, LSF and Kubernetes."""
FLIGHTS_MAX = 100_000
"""Default limit of flights: a sweep is a product, and one axis too many is hours of work."""


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
    about = "fly only part I of N; 'auto' takes I and N from the variables of a job array"
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
    add("--number", action="append", type=new_name, default=[], metavar="NAME", help=about)
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
    """Parse "I/N": shard I of N shards, counted from 1.

    "auto" reads I and N from the environment variables of a job array, "auto/N" only I.
    """
    index, _, count = text.partition("/")
    if index == "auto":
        return _shard_of_array(count)
    if index.isdecimal() and count.isdecimal() and 1 <= int(index) <= int(count):
        return int(index), int(count)
    raise argparse.ArgumentTypeError(f"'{text}' is not I/N with I from 1 to N, or auto")


def _shard_of_array(count: str) -> tuple[int, int]:
    """Return the shard of this job of an array; `count` is the number of shards, if it is given.

    An array that has not all of its jobs, such as the failed jobs alone, is refused: other numbers
    would belong to its jobs, and flights would be left out without a word.
    """
    array = _find_array()
    names = (array.this, array.all, array.first, array.last)
    seen = {name: os.environ[name] for name in names if os.environ.get(name)}
    shown = ", ".join(f"{name}={value}" for name, value in seen.items())
    count = count or seen.get(array.all, "")
    if not count:
        lacks = f"{array.all} is not set" if array.all else "no variable has their number"
        raise argparse.ArgumentTypeError(f"auto: {shown}, but {lacks}; give auto/N")
    if all(value.isdecimal() for value in [*seen.values(), count]):
        total, first = int(count), int(seen.get(array.first, array.begin))
        last, index = int(seen.get(array.last, first + total - 1)), int(seen[array.this])
        is_whole = int(seen.get(array.all, total)) == total == last - first + 1
        if is_whole and first <= index <= last:
            return index - first + 1, total
    raise argparse.ArgumentTypeError(
        f"auto: {shown} is no job of an array with all of its {count} jobs; give the shard itself, "
        "such as --shard 7/16, or leave out --shard to fly what is missing"
    )


def _find_array() -> JobArray:
    for array in ARRAYS:
        index = os.environ.get(array.this, "")
        if index and (array, index) != (LSF, "0"):  # LSF gives 0 to a job that is in no array
            return array
    known = ", ".join(array.this for array in ARRAYS)
    raise argparse.ArgumentTypeError(f"auto needs one of {known}; give I/N")


def execute(options: argparse.Namespace) -> int:
    """Run the chosen verb; return the exit code."""
    # First: until then, the first process of a container ignores signals.
    interrupt_on_signals()
    from cloudrc.cli import sweep_run as actions

    functions = (actions.run, actions.print_status, actions.fly_again, actions.draw_figure,
                 actions.print_rows)  # fmt: skip
    return dict(zip(VERBS, functions, strict=True))[options.verb](options)
