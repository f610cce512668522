# SPDX-License-Identifier: Apache-2.0

"""`cloudrc bench`: measure how much processor time the closed loop needs on this machine.

The command flies the experiment `paper`. For comparison, it also measures two other workloads: one
replays only the physics of this flight, in C (`mujoco.rollout`, one thread); the other flies the
experiment as one flight of a sweep, which also computes the metrics. It also compares three flights
with each other whose clouds compute more or less. The command repeats each measurement and prints
the shortest processor time.
"""

from __future__ import annotations

from cloudrc.doors.cli.output import output_argument, print_result
from cloudrc.doors.cli.parser import Options, Parser, read_count

EPILOG = """\
'raw mj_step' replays the thrusts and the drag of the same flight in C and must
end in the same bits. Close other programs before you compare two machines; the
ratios of one run are comparable between machines."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    output_argument(parser)
    about = "how often to measure each part (default: 7)"
    parser.add_argument("--repeats", type=read_count, default=7, metavar="N", help=about)


def execute(options: Options) -> None:
    """Run all measurements; print the processor time per physics step or per virtual time."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.bench import as_text, bench

    with Progress(f"measures each part {options.repeats} times"):
        document = bench(options.repeats)
    print_result(options.output, document, as_text(document))
