"""`cloudrc sweep`: fly a grid of settings with several seeds; one row of numbers per flight."""

from __future__ import annotations

import argparse
import os
import sys
from collections import Counter
from collections.abc import Mapping
from contextlib import closing
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any

from rich.console import Console

from cloudrc.cli.advice import advise
from cloudrc.cli.extras import MODES, require
from cloudrc.cli.output import (
    escape,
    format_document,
    is_live,
    output_argument,
    print_line,
    print_or_drop,
    table,
)
from cloudrc.cli.parser import input_file, read_count
from cloudrc.cli.pool import interrupt_on_signals, map_as_done, take_each
from cloudrc.errors import BadInputError, InvalidRunError

if TYPE_CHECKING:
    from cloudrc.sweep.plan import Flight, Plan
    from cloudrc.sweep.store import Row

ACTIONS = {
    "run": "fly all points of a grid, or those that are missing in --out",
    "status": "count the rows and the successful flights of a sweep",
    "fly": "fly one row again with a recording and a report, and compare the hashes",
    "figure": "draw metrics and success over an axis, as PDF, PNG and SVG",
}
EPILOG = """\
examples:
  cloudrc sweep run my-sweep.yaml
  cloudrc sweep run my-sweep.yaml --out runs/mine    again: fly what is missing
  cloudrc sweep status runs/latest-sweep
  cloudrc sweep fly runs/latest-sweep 73434426a8081810
  cloudrc sweep figure runs/latest-sweep --x link.both.delay_ms

docs/sweeps.md describes the file of a sweep and the shards of a cluster."""
VERDICTS = ("success", "failure", "error")
ARRAYS = {
    "SLURM_ARRAY_TASK_ID": ("SLURM_ARRAY_TASK_COUNT", "SLURM_ARRAY_TASK_MIN"),
    "JOB_COMPLETION_INDEX": ("JOB_COMPLETIONS", ""),
}
"""Variable with the index of this process -> variables with the number of processes, and with the
first index, which is 0 without a variable."""
PLAIN_PERIOD = 30.0
"""Time between two lines of progress that is not shown on a terminal [s]."""


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions")
    parsers = {
        name: actions.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}.")
        for name, text in ACTIONS.items()
    }
    add = parsers["run"].add_argument
    add("file", type=input_file, metavar="FILE", help="file of the sweep (.yaml)")
    about = "folder of the sweep (default: a new one in runs/); if it has rows, fly the others"
    add("--out", type=Path, metavar="DIR", help=about)
    about = "number of parallel processes (default: one per usable core)"
    add("--jobs", type=read_count, default=10_000, metavar="N", help=about)
    about = "fly the failed or all flights again with a recording, into DIR/KEY"
    add("--record", choices=("failed", "all"), help=about)
    about = "fly only part I of N; 'auto' takes I and N from Slurm or Kubernetes"
    add("--shard", type=_shard, metavar="I/N", help=about)
    for name in ("status", "fly", "figure"):
        about = "folder of a sweep"
        parsers[name].add_argument("folder", type=Path, metavar="DIR", help=about)
    parsers["fly"].add_argument("key", metavar="KEY", help="key of the row, or its first digits")
    add = parsers["figure"].add_argument
    about = "metric to draw; repeatable (default: three that matter first)"
    add("--number", action="append", default=[], metavar="NAME", help=about)
    about = "axis of the sweep along x (default: the first one with numbers)"
    add("--x", metavar="AXIS", help=about)
    about = "axis with one line per value (default: the first of the others)"
    add("--by", metavar="AXIS", help=about)
    about = "path of the files, with or without a suffix (default: DIR/figure)"
    add("--out", type=Path, metavar="FILE", help=about)
    for name in ("run", "status", "fly"):
        output_argument(parsers[name])


def _shard(text: str) -> tuple[int, int]:
    """Parse I/N, auto or auto/N to the number of the shard, from 1 on, and that of all shards."""
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
        text = f"'{text}' is not I/N with I from 1 to N, auto, or auto/N"
        raise argparse.ArgumentTypeError(text)
    return int(index) - int(first) + 1, int(count)


def execute(options: argparse.Namespace) -> int:
    """Run the chosen action; return the exit code."""
    if options.action is None:
        names = ", ".join(ACTIONS)
        raise BadInputError(f"an action is missing: {names}; see 'cloudrc sweep --help'")
    actions = {"run": run, "status": print_status, "fly": fly_again, "figure": draw_figure}
    return actions[options.action](options)


def run(options: argparse.Namespace) -> int:
    """Fly the flights of a sweep that have no row yet; return the exit code of the worst row."""
    from cloudrc.cli.run import new_folder
    from cloudrc.sweep import store
    from cloudrc.sweep.plan import read_plan

    interrupt_on_signals()
    require("a sweep", MODES["virtual"] if options.record else ("world",))
    if options.shard and options.out is None:
        raise BadInputError("--shard needs --out, the folder that all shards share")
    plan, folder, (shard, count) = read_plan(options.file), options.out, options.shard or (None, 1)
    _warn(plan)
    if folder is None or not (folder / store.FILE).is_file():
        folder = new_folder(folder, f"sweep-{options.file.stem}", "latest-sweep")
    before = store.begin(folder, plan)
    mine = [*plan.flights.values()][(shard or 1) - 1 :: count]
    jobs = [(each, options.record, folder) for each in mine if each.key not in before]
    part = f", shard {shard} of {count}" if shard else ""
    head = f"{len(plan.points)} points x {len(plan.seeds)} seeds{part}: {len(mine)} flights"
    view = Progress(options, f"{plan.points[0].name}: {head}", len(mine), len(jobs))
    with store.append_rows(folder, shard) as append, closing(view):

        def take(row: Row) -> None:
            append(row)
            view.see(row)

        stopped, code = take_each(map_as_done(fly_job, jobs, options.jobs), take)
    rows = store.finish(folder, plan)
    if stopped:
        again = f"cloudrc sweep run {options.file} --out {folder}"
        print_line(f"cloudrc: {stopped}; to continue: {again}", sys.stderr)
    if options.output != "table":
        print_or_drop(format_document(store.read_summary(folder), options.output))
    else:
        name = store.TABLE if len(rows) == len(plan.flights) else store.SUMMARY
        print_or_drop(f"\n{_verdicts(rows)}\n\n{escape(str(folder / name))}")
    return code or int(any(row["verdict"] != "success" for row in rows.values()))


def _warn(plan: Plan) -> None:
    """Print each warning about the points of a sweep once."""
    for text in dict.fromkeys(text for point in plan.points for text in advise(point)):
        print_line(f"cloudrc: warning: {text}", sys.stderr)


def fly_job(job: tuple[Flight, str | None, Path]) -> Row:
    """Fly, record the flight if that is asked for, and return the row."""
    from cloudrc.sweep.flight import ERROR, fly_point
    from cloudrc.sweep.store import make_row

    flight, record, folder = job
    flown = fly_point(flight.experiment)
    wanted = record == "all" or (record == "failed" and flown.verdict != "success")
    if wanted and flown.verdict != ERROR:
        _fly_into(folder / flight.key, flight, page=False)
    return make_row(flight, flown)


def _fly_into(folder: Path, flight: Flight, *, page: bool) -> dict[str, Any]:
    from cloudrc.cli.run import fly

    folder.mkdir(exist_ok=True)
    return fly(flight.experiment, "virtual", folder, page=page)


def fly_again(options: argparse.Namespace) -> int:
    """Fly a row again with recording and report; exit with 6 if its records differ."""
    from cloudrc.cli.report import summary
    from cloudrc.sweep import store
    from cloudrc.sweep.plan import read_plan

    require("a report", MODES["virtual"])
    store.read_summary(options.folder)
    plan, rows = read_plan(options.folder / store.FILE), store.read_rows(options.folder)
    found = [key for key in rows if key.startswith(options.key)]
    if len(found) != 1 or found[0] not in plan.flights:
        text = "no single row has this key; the keys are in the rows"
        raise BadInputError(f"{options.folder}: {options.key}: {text}")
    flight, folder = plan.flights[found[0]], options.folder / found[0]
    report = _fly_into(folder, flight, page=True)
    if options.output == "table":
        print_or_drop(escape(f"{flight.point or 'the experiment'}, seed {flight.seed}"))
        print_or_drop(summary(report, folder))
    else:
        print_or_drop(format_document(report, options.output))
    if rows[flight.key]["records_sha256"] != report["records_sha256"]:
        text = "a file of the sweep, a package or the processor has changed; fly the sweep again"
        raise InvalidRunError(f"{flight.key}: this flight differs from that of the sweep: {text}")
    print_or_drop("\nthe flight is that of the sweep: equal records", sys.stderr)
    return 0


def print_status(options: argparse.Namespace) -> int:
    """Print how many flights of a sweep are done, and the success of each value of each axis."""
    from cloudrc.sweep import store

    summary, rows = store.read_summary(options.folder), store.read_rows(options.folder)
    values = []
    for axis, choices in summary["axes"].items():
        for value in choices:
            found = [row["verdict"] for row in rows.values() if row["point"][axis] == value]
            counts = {"flights": len(found), "success": found.count("success")}
            values.append({"axis": axis, "value": value, **counts})
    if options.output == "table":
        print(f"{len(rows)} of {summary['flights']} flights are done: {_verdicts(rows)}")
        cells = [("axis", "value", "success")]
        for each in values:
            share = f"{each['success']}/{each['flights']}"
            cells.append((each["axis"], store.as_text(each["value"]), share))
        print(f"\n{table(cells, right=(2,))}" if values else "", end="\n" * bool(values))
    else:
        counts = dict(Counter(row["verdict"] for row in rows.values()))
        document = {"schemaVersion": 1, "flights": summary["flights"], "counts": counts}
        print(format_document({**document, "axes": values}, options.output))
    return 0


def draw_figure(options: argparse.Namespace) -> int:
    """Draw a sweep and write the figure as PDF, PNG and SVG; print the caption and the paths."""
    require("a figure", ("report",))
    from cloudrc.files import write_atomically
    from cloudrc.sweep.figure import draw_sweep
    from cloudrc.sweep.pairs import read_flights

    rows = read_flights(options.folder)
    files, caption = draw_sweep(rows, options.number, options.x, options.by)
    out = options.out or options.folder / "figure"
    stem = out.stem if out.suffix.removeprefix(".") in files else out.name
    print_or_drop(f"{caption}\n")
    for kind, data in files.items():
        path = out.with_name(f"{stem}.{kind}")
        write_atomically(path, data)
        print_or_drop(escape(str(path)))
    return 0


def _verdicts(rows: Mapping[str, Row]) -> str:
    counts = Counter(row["verdict"] for row in rows.values())
    return ", ".join(f"{counts[name]} {name}" for name in VERDICTS if counts[name]) or "none"


class Progress:
    """Shows how many flights are done: in a line on a terminal, else in a line every 30 s."""

    def __init__(self, options: argparse.Namespace, head: str, total: int, missing: int) -> None:
        """Print `head`; set the number of flights, and of those that have no row yet."""
        self._stream = sys.stdout if options.output == "table" else sys.stderr
        self._total, self._missing, self._done, self._failed = total, missing, 0, 0
        self._began = self._printed = monotonic()
        self._told = set[str]()
        done = total - missing
        print_or_drop(escape(f"{head}, {done} done before" if done else head), self._stream)
        self._status = Console(file=self._stream).status("") if is_live(self._stream) else None
        if self._status:
            self._status.start()

    def see(self, row: Row) -> None:
        """Count a new row; print each kind of error once."""
        self._done += 1
        self._failed += row["verdict"] != "success"
        if row.get("text", "") not in ("", *self._told):
            self._told.add(row["text"])
            print_or_drop(escape(f"{row['key']}: error: {row['text']}"), self._stream)
        if self._status:
            self._status.update(self._line())
        elif monotonic() - self._printed >= PLAIN_PERIOD:
            self._printed = monotonic()
            print_or_drop(self._line(), self._stream)

    def _line(self) -> str:
        rate = self._done / max(monotonic() - self._began, 1e-3)
        left = (self._missing - self._done) / rate
        done = self._total - self._missing + self._done
        time = f"{left:.0f} s" if left < 120 else f"{left / 60:.0f} min"
        failed = f", {self._failed} failed" if self._failed else ""
        return f"{done}/{self._total}  {rate:.1f} flights/s, {time} left{failed}"

    def close(self) -> None:
        """Erase the line on a terminal."""
        if self._status:
            self._status.stop()
