# SPDX-License-Identifier: Apache-2.0

"""`cloudrc reproduce`: put the statements of the paper beside what is measured here."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.errors import BadInputError
from cloudrc.base.requirements import MODES, require
from cloudrc.base.text import escape
from cloudrc.doors.cli.output import again, tell, warn
from cloudrc.doors.cli.parser import COUNT_MAX, Options, Parser, read_count
from cloudrc.flight.folder import results_folder

if TYPE_CHECKING:
    from collections.abc import Sequence

    from cloudrc.flight.trials.rows import Row

EPILOG = """\
examples:
  cloudrc reproduce
  cloudrc reproduce -o paper --link lte
  cloudrc link record ping.log --halve-rtt -o mine.csv &&
      cloudrc reproduce --link mine.csv

Flies the paper's mission in virtual time, as published and with the newest
command, over its links P1, P2 and P3, and over all three in one mission; it
takes about two minutes on two cores. The folder has the table
(reproduce.json, reproduce.md), the figure (reproduce.pdf, .png, .svg) and a
line for each flight (rows.jsonl). With -o DIR of an earlier call, only what is
missing flies. docs/reproduce.md explains the table."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    about = "folder (default: a new one in runs/); if it has rows, fly the others"
    parser.add_argument("-o", "--out", type=Path, metavar="DIR", help=about)
    about = "add a column: a trace of 'link record', or a profile (a name or a file)"
    parser.add_argument("--link", default="", metavar="FILE", help=about)
    parser.add_argument(
        "--seeds", type=read_count, default=10, metavar="N", help="fly seeds 1 to N (default: 10)"
    )
    about = "parallel processes (default: one per core)"
    parser.add_argument("--jobs", type=read_count, default=COUNT_MAX, metavar="N", help=about)


def execute(options: Options) -> int:
    """Fly what is missing; write and print the table, and draw the figure."""
    from cloudrc.doors.cli.progress import Progress, SweepView
    from cloudrc.flight.trials.play import run
    from cloudrc.flight.trials.rows import Rows
    from cloudrc.studies.reproduce.flights import plan

    require("the paper's mission", MODES["virtual"])
    if options.link:
        _check_link(options.link)
    with Progress("checks the flights"):
        flights = plan(options.seeds, options.link)
    if options.link:
        own = [each.resolved for each in flights if each.point["column"] == Path(options.link).name]
        warn(own[0], seeds=options.seeds)
    with results_folder(options.out, "reproduce", "paper") as folder:
        rows = Rows(folder)
        missing = [each for each in flights if each.key not in rows.kept]
        head = f"the paper, seeds 1 to {options.seeds}: {len(missing)} flights"
        with SweepView(head, len(missing), on_stdout=True) as view:
            stopped = run(missing, rows, options.jobs, view.see, in_order=False)
        if stopped:
            tell(f"{stopped}; {again(options.out, folder)}")
            return stopped.exit_code
        with Progress("draws the figure"):
            text = _write(folder, [rows.kept[each.key] for each in flights])
    print(f"\n{text}\n\n{escape(str(folder / 'reproduce.pdf'))}")
    return 0


def _check_link(link: str) -> None:
    """Raise a BadInputError if the link is neither a trace nor a profile."""
    from cloudrc.config.profile import load_profile
    from cloudrc.link.traces import read_trace
    from cloudrc.studies.reproduce.flights import traces_of

    traces = {Path(os.path.abspath(each)) for each in traces_of(link).values()}
    if not all(each.exists() for each in traces):
        raise BadInputError(
            f"--link {link}: there is no such file; give a trace of 'cloudrc link record', or a "
            "profile such as lte"
        )
    try:
        for each in sorted(traces):
            read_trace(each)
        if not traces:
            load_profile(link)
    except BadInputError as error:
        raise BadInputError(f"--link: {error}") from None


def _write(folder: Path, rows: Sequence[Row]) -> str:
    """Write the table and the figure into a folder; return the table as text."""
    from cloudrc.base.files import write_atomically, write_json
    from cloudrc.base.source import code_hash
    from cloudrc.flight.in_memory import fly_in_memory
    from cloudrc.results.report.document import versions
    from cloudrc.studies.reproduce.figure import draw
    from cloudrc.studies.reproduce.flights import shown
    from cloudrc.studies.reproduce.table import as_markdown, as_text, describe

    made = {"versions": versions(["cloudrc", "mujoco", "numpy"]), "code": code_hash()}
    document = {"schemaVersion": 1, **made, **describe(rows)}
    write_json(folder / "reproduce.json", document)
    write_atomically(folder / "reproduce.md", as_markdown(document).encode())
    for kind, content in draw(fly_in_memory(shown())).items():
        write_atomically(folder / f"reproduce.{kind}", content)
    return as_text(document)
