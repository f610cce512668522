# SPDX-License-Identifier: Apache-2.0

"""`cloudrc capacity EXPERIMENT`: how many robots do one cell and one cloud carry?"""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.errors import CloudrcError
from cloudrc.base.text import cells, csv_table, escape, latex_table
from cloudrc.doors.cli.output import TABLES, output_argument, print_result, tell, warn
from cloudrc.doors.cli.parser import (
    Options,
    Parser,
    number,
    read_count,
    read_list,
    set_argument,
    settings_from,
    whole_number,
)

EPILOG = """\
examples:
  cloudrc capacity steps --cell 1000 --queue fifo,newest --seeds 10
  cloudrc capacity steps --cell 1000 --queue fifo:9 --controllers pid,mpc
  cloudrc capacity steps --set cloud.cores=1 --set cloud.compute_ms=2

The capacity is the largest fleet in which all robots succeed that succeed
alone. Seed 1 finds it by bisection; then it flies, and one robot less and one
more, with all seeds. A fleet is stopped at its first failure. The mission gets
a time limit of 1.4 times its duration alone, unless criteria.time_limit_s is
set. docs/fleet.md explains the result."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = "experiment to fly: a shipped name or a YAML file (default: steps)"
    parser.add_argument("experiment", nargs="?", default="steps", metavar="EXPERIMENT", help=about)
    about = "rate of the cell in each direction (default: that of the experiment)"
    parser.add_argument("--cell", type=number(1e-3, 1e9, "kbit/s"), metavar="KBIT", help=about)
    names = read_list(str)
    about = (
        "compare these queues of the cell: fifo, drr, priority or newest, with :PACKETS if wanted"
    )
    parser.add_argument("--queue", type=names, default=[], metavar="NAME,...", help=about)
    about = "compare these controllers"
    parser.add_argument("--controllers", type=names, default=[], metavar="NAME,...", help=about)
    parser.add_argument(
        "--seeds", type=read_count, default=5, metavar="N", help="fly seeds 1 to N (default: 5)"
    )
    about = "largest fleet to try (default: 64)"
    parser.add_argument("--max", type=whole_number(1, 1000), default=64, metavar="N", help=about)
    set_argument(parser)
    about = "folder of the results; with those of an earlier call, fly what is missing"
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help=f"{about} (default: runs/capacity-...)"
    )
    output_argument(parser, forms=TABLES)


def execute(options: Options) -> None:
    """Find the capacity of each queue and controller; write and print it, and draw the figure."""
    from cloudrc.base.files import write_atomically, write_json
    from cloudrc.base.requirements import MODES, require
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.flight.folder import results_folder
    from cloudrc.flight.trials.rows import Rows
    from cloudrc.results.report.figures.style import Look
    from cloudrc.studies.capacity import Sought, describe, fly
    from cloudrc.studies.capacity_text import (
        CAPTION,
        COLUMNS,
        as_text,
        draw_capacity,
        in_words,
        rows_of,
    )

    require("a capacity", MODES["virtual"])
    asked = settings_from(options, Sought)
    conditions = asked.conditions()
    warn(*(each.fleet for each in conditions), seeds=options.seeds)
    name = conditions[0].fleet.name
    with results_folder(options.out, "capacity", name) as folder, Progress("flies") as view:
        view.say(f"{options.experiment}: how many robots? seeds 1 to {options.seeds}")
        try:
            fly(conditions, Rows(folder), lambda row: view.say(in_words(row)))
        except CloudrcError:
            tell(f"the finished fleets are kept; the same call with --out {folder} goes on")
            raise
        document = describe(asked, conditions)
        write_json(folder / "capacity.json", {"schemaVersion": 1, **document})
        for kind, content in draw_capacity(document, Look(width=3.5)).items():
            write_atomically(folder / f"capacity.{kind}", content)
    rows = rows_of(document)
    tables = {"csv": csv_table(rows), "latex": latex_table(cells(rows, COLUMNS))}
    text = f"\n{as_text(document)}\n\n{CAPTION}\n\n{escape(str(folder / 'capacity.pdf'))}"
    print_result(options.output, document, text, **tables)
