"""`cloudrc sweep`: fly a grid of settings with several seeds; write a row of numbers per flight."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from cloudrc import __version__
from cloudrc.cli.cluster_flags import release_arguments
from cloudrc.cli.interrupts import interrupt_on_signals
from cloudrc.cli.output import output_argument
from cloudrc.cli.parser import COUNT_MAX, add_verbs, figure_arguments, read_count
from cloudrc.renamed import new_name

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
ARRAYS = {
    "SLURM_ARRAY_TASK_ID": ("SLURM_ARRAY_TASK_COUNT", "SLURM_ARRAY_TASK_MIN"),
    "JOB_COMPLETION_INDEX": ("JOB_COMPLETIONS", ""),
}
"""Environment variable with the index of a process -> variables with the number of processes and
with the first index ("": it is 0)."""
IMAGE = f"cloudrc/world:{__version__}"


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    run, status, fly, figure, rows = add_verbs(parser, VERBS).values()
    run.add_argument("file", type=Path, metavar="FILE", help="file of the sweep (.yaml)")
    about = "folder of the sweep (default: a new one in runs/); if it has rows, fly the others"
    run.add_argument("--out", type=Path, metavar="DIR", help=about)
    about = "number of parallel processes (default: one per usable core)"
    run.add_argument("--jobs", type=read_count, default=COUNT_MAX, metavar="N", help=about)
    about = "fly the failed or all flights again with a recording, into DIR/KEY"
    run.add_argument("--record", choices=("failed", "all"), help=about)
    about = "fly only part I of N; 'auto' takes I and N from Slurm or Kubernetes"
    run.add_argument("--shard", type=_shard, metavar="I/N", help=about)
    rows.add_argument("file", type=Path, metavar="FILE", help="file of flights, of a Job")
    rows.add_argument("--shard", type=_shard, default=(1, 1), metavar="I/N", help=about)
    add = release_arguments(run)
    about = "fly in the pods of a Job instead of on this machine"
    add("--on", choices=("kubernetes",), help=about)
    add("--shards", type=read_count, default=8, metavar="N", help="number of pods (default: 8)")
    about = f"image of the pods (default: {IMAGE})"
    add("--image", default=IMAGE, metavar="IMAGE", help=about)
    add("--cpu", default="1", metavar="CPU", help="CPU request of a pod (default: 1)")
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


def _shard(text: str) -> tuple[int, int]:
    """Parse "I/N": shard I of N shards, counted from 1.

    "auto" reads I and N from the environment variables of a job array, "auto/N" only I.
    """
    index, _, count = text.partition("/")
    first = "1"
    if index == "auto":
        name = next((name for name in ARRAYS if name in os.environ), "")
        if not name:
            raise argparse.ArgumentTypeError(f"auto needs {' or '.join(ARRAYS)}; give I/N")
        index, (of, begin) = os.environ[name], ARRAYS[name]
        count, first = count or os.environ.get(of, ""), os.environ.get(begin, "0")
        if not count:
            raise argparse.ArgumentTypeError(f"{of} is not set; give auto/N")
    valid = all(word.isdecimal() for word in (index, count, first))
    if not valid or not 0 <= int(index) - int(first) < int(count):
        raise argparse.ArgumentTypeError(f"'{text}' is not I/N with I from 1 to N, or auto")
    return int(index) - int(first) + 1, int(count)


def execute(options: argparse.Namespace) -> int:
    """Run the chosen verb; return the exit code."""
    # First: until then, the first process of a container ignores signals.
    interrupt_on_signals()
    from cloudrc.cli import sweep_run as actions

    functions = (actions.run, actions.print_status, actions.fly_again, actions.draw_figure,
                 actions.print_rows)  # fmt: skip
    return dict(zip(VERBS, functions, strict=True))[options.verb](options)
