# SPDX-License-Identifier: Apache-2.0

"""`cloudrc measure compute`: how long does a controller compute a command?"""

from __future__ import annotations

import os
from pathlib import Path

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.paths import check_new
from cloudrc.doors.cli.output import print_line, tell
from cloudrc.doors.cli.parser import Options, Parser, add_verbs, number, set_argument
from cloudrc.flight.machine import usable_cores

VERBS = {"compute": "measure how long a controller computes a command"}
"""Verb -> its line in the help."""
QUANTILES = {"median": 0.5, "p99": 0.99, "longest": 1.0}
EPILOG = """\
examples:
  cloudrc measure compute mpc --cpus 0.2
  cloudrc measure compute ./my_controller.py --seconds 40 --out times.txt
  cloudrc measure compute runs/latest
  cloudrc run steps --mode virtual --set cloud.compute_ms=./compute.txt

A controller flies the experiment 'steps' in real time, and each computation is
timed. --cpus limits this process as a container is limited: of each 100 ms it
computes for a share, and then stands still. Of a RUN, the file gets the periods
of cloud's loop in real time, or the times of cloud.compute_measured.

The file has the head compute_ms, and a duration in ms in each further line.
cloud.compute_ms takes it, and so does cloudrc eval --compute."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    (compute,) = add_verbs(parser, VERBS).values()
    compute.epilog = EPILOG
    about = "name or file of a controller, or the folder of a run"
    compute.add_argument("what", metavar="CONTROLLER|RUN", help=about)
    about = "limit of processors, such as 0.2; it needs the permission to make a control group"
    compute.add_argument("--cpus", type=number(0.01, 64, "processors"), metavar="N", help=about)
    about = "longest duration (default: 20)"
    compute.add_argument(
        "--seconds", type=number(1, 3600, "seconds"), default=20.0, metavar="S", help=about
    )
    set_argument(compute)
    about = "new file (default: compute.txt)"
    compute.add_argument(
        "--out", type=Path, default=Path("compute.txt"), metavar="FILE", help=about
    )


def execute(options: Options) -> None:
    """Measure, write the file, and print a summary."""
    check_new(options.out, "name another file with --out")
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.compute import of_controller, of_run

    load, cores = os.getloadavg()[0], usable_cores()
    with Progress(f"measures {options.what}"):
        if Path(options.what).is_dir():
            found = of_run(Path(options.what))
        else:
            found = of_controller(options.what, options.set, options.cpus, options.seconds)
    if load > cores and not Path(options.what).is_dir():
        why = "the times have waits of this machine; close programs, and measure again"
        tell(f"warning: {cores} cores with a load of {load:.1f}: {why}")
    if found.unlimited:
        tell(f"warning: measured without a CPU limit: {found.unlimited}")
    if not (times := sorted(found.times_ms)):
        raise BadInputError(f"{options.what}: there is no computation to measure")
    head = f"# computing times of {found.where}", "compute_ms"
    lines = [*head, *(f"{time:.4f}" for time in found.times_ms)]
    options.out.write_text("\n".join(lines) + "\n", encoding="utf-8")
    mean, last = sum(times) / len(times), len(times) - 1
    shown = [f"{name} {times[round(last * q)]:.3g}" for name, q in QUANTILES.items()]
    print_line(f"{found.where}: {len(times)} times, mean {mean:.3g}, {', '.join(shown)} ms")
    named = options.out if options.out.is_absolute() else f"./{options.out}"
    print_line(f"{options.out}: fly it with --set cloud.compute_ms={named}")
