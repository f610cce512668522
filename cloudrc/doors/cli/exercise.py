# SPDX-License-Identifier: Apache-2.0

"""`cloudrc class`: hand out and score a task, by default the exercise of docs/exercise.md.

The students' functions run in a process of their own for each part of the task, so that a crash
costs the points of this part only. The process is no sandbox: a student's file has all rights of
the user.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from shlex import quote
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import BadInputError
from cloudrc.base.files import write_atomically
from cloudrc.base.outside.paths import check_there, read_file
from cloudrc.doors.cli.output import (
    TABLE,
    format_document,
    output_argument,
    print_line,
    print_lines,
    print_result,
    tell,
)
from cloudrc.doors.cli.parser import Options, Parser, add_verbs, read_count, read_size
from cloudrc.studies.exercise.watch import LIMITS, Limits

if TYPE_CHECKING:
    from cloudrc.config.task import Task

VERBS = {"new": "write the files that students fill in", "check": "score students' files"}
EPILOG = """\
examples:
  cloudrc class new exercise        three files to fill in
  cloudrc class check exercise      the points of each part
  cloudrc class new TASK.yaml       a task of your own, see docs/class.md
  cloudrc class check hand-ins/* --task TASK.yaml > points.csv
  cloudrc class check hand-ins/* --task TASK.yaml --resume points.csv
  cloudrc class check /autograder/submission -o gradescope > results.json

'check' runs the files in DIR with all your rights; it is no sandbox."""
JOBS_MAX = 1000


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    new, check = add_verbs(parser, VERBS).values()
    about = "file of your own task (.yaml), beside the files to fill in"
    new.add_argument("task", nargs="?", metavar="TASK", help=about)
    new.add_argument(
        "folder", type=Path, metavar="DIR", help="folder for the files (default: named as TASK)"
    )
    check.add_argument(
        "folders", nargs="+", type=Path, metavar="DIR", help="hand-in: a folder or a zip"
    )
    about = "the task (default: task.yaml in DIR, or else the exercise)"
    check.add_argument("--task", type=Path, metavar="TASK", help=about)
    about = "hand-ins at once (default: one per usable core)"
    check.add_argument("--jobs", type=read_count, default=JOBS_MAX, metavar="N", help=about)
    about = "memory of a part and its children together (default: 2Gi)"
    check.add_argument(
        "--memory", type=read_size, default=LIMITS.memory, metavar="SIZE", help=about
    )
    about = f"processes of a part at once (default: {LIMITS.processes})"
    check.add_argument(
        "--processes", type=read_count, default=LIMITS.processes, metavar="N", help=about
    )
    about = "table of an earlier call: score the hand-ins without a row, and add their rows"
    check.add_argument("--resume", type=Path, metavar="FILE", help=about)
    output_argument(check, "output format, csv for several hand-ins", forms=("gradescope", "csv"))


def execute(options: Options) -> None:
    """Write a student's files, or score hand-ins; return 0 whatever the score."""
    if options.verb == "new":
        _new(options.task, options.folder)
        return
    given = list[Path]()
    for path in dict.fromkeys(path.resolve() for path in options.folders):
        if path.is_dir() or (path.suffix == ".zip" and path.is_file()):
            given.append(path)
        else:
            if len(options.folders) == 1:
                check_there(path, "'cloudrc class new' makes one")
            tell(f"{path}: neither a folder nor a zip; left out")
    with TemporaryDirectory() as scratch:
        if len(options.folders) > 1 or options.output == "csv" or options.resume:
            _check_all(options, given, Path(scratch))
        elif given:
            _check(options, given[0], Path(scratch))


def _new(task: str | None, folder: Path) -> None:
    from cloudrc.studies.exercise.files import SHIPPED, write_files

    if task is None and folder.suffix in (".yaml", ".yml"):
        task, folder = str(folder), Path(folder.stem)
    source = Path(task) if task else SHIPPED
    read, needed = _read(source), set[Path]()
    if source != SHIPPED:
        from cloudrc.studies.exercise.checks import needed_files

        beside = source.resolve().parent
        needed = needed_files(read, beside)
        if outside := [file for file in needed if not file.is_relative_to(beside)]:
            raise BadInputError(f"{source}: a flight needs {outside[0]}; put it beside the task")
    names = write_files(folder, source, needed)
    if source != SHIPPED:
        _show_points(folder.resolve(), source.resolve())
    command = f"cloudrc class check {quote(str(folder))}"
    print_line(f"fill in {', '.join(names)} in {folder}, then: {command}")


def _show_points(folder: Path, source: Path) -> None:
    """Print the points of the files as they are handed out, and of cloudrc's own parts."""
    from cloudrc.base.text import table
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.exercise.scoring import check

    cells = [("part", "test", "points", "files to fill in", "cloudrc's own")]
    with Progress("scores the files to fill in, and cloudrc's own parts"):
        for files, own in zip(check(folder, source), check(None, source), strict=True):
            points = (f"{row['points']:g}" for row in (files, own))
            cells.append((files["part"], files["test"], str(files["max_points"]), *points))
    print_lines(table(cells, right=(2, 3, 4)).splitlines())


def _read(source: Path) -> Task:
    """Read a task, and check the flights of a lecturer's own."""
    from cloudrc.config.task import read_task
    from cloudrc.studies.exercise.files import SHIPPED

    task = read_task(source)
    if source != SHIPPED:
        from cloudrc.studies.exercise.checks import check_flights

        check_flights(task, source.resolve().parent)
    return task


def _limits(options: Options) -> Limits:
    return Limits(memory=int(options.memory), processes=options.processes)


def _check(options: Options, given: Path, scratch: Path) -> None:
    """Score a hand-in, and show each test as it ends."""
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.exercise import score
    from cloudrc.studies.exercise.files import open_hand_in
    from cloudrc.studies.exercise.scoring import check

    hand_in = open_hand_in(given, options.task, scratch / "0")
    if hand_in.unreadable:
        raise BadInputError(hand_in.unreadable)
    task = _read(hand_in.source)
    if options.output != "gradescope":  # there, a hand-in without the files gets 0 points
        _check_files(given, hand_in.folder, [*task.files.values()])
    rows = []
    with Progress(f"scores {given}") as view:
        view.say(f"scores {given}")
        for row in check(hand_in.folder, hand_in.source, _limits(options)):
            rows.append(row)
            view.say(f"  {row['part']}, {row['test']}: {row['points']:g}/{row['max_points']}")
    result = score.sum_up(rows)
    forms = {"gradescope": format_document(score.for_gradescope(result), "json")}
    print_result(options.output, result, score.as_text(result), **forms)


def _check_all(options: Options, given: Sequence[Path], scratch: Path) -> None:
    """Score several hand-ins at once; write each row of the table as soon as it is there."""
    from cloudrc.config.task import read_task
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.flight.trials.workers import map_in_order, take_each
    from cloudrc.studies.exercise.files import open_hand_in
    from cloudrc.studies.exercise.score import as_row, columns
    from cloudrc.studies.exercise.scoring import score

    if options.output == "gradescope":
        raise BadInputError("-o gradescope: give one DIR")
    if options.resume and options.output not in (TABLE, "csv"):
        raise BadInputError(f"--resume: its table is CSV; leave out -o {options.output}")
    task = options.task and options.task.resolve()
    if task:
        _read(task)
    as_table = options.output in (TABLE, "csv")
    hand_ins = [
        open_hand_in(path, task, scratch / str(number))._replace(name=name)
        for number, (path, name) in enumerate(zip(given, _names_of(given), strict=True))
    ]
    heads, results = columns(read_task(each.source) for each in hand_ins), dict[str, Any]()
    with ExitStack() as stack:
        table = _Table(options.resume, heads, stack) if as_table else None
        left = [each for each in hand_ins if table is None or each.name not in table.known]
        view = stack.enter_context(Progress(f"scores {len(left)} hand-ins"))

        def take(found: tuple[str, dict[str, Any]]) -> None:
            name, results[name] = found
            if table:
                table.write(as_row(*found, heads))
            view.say(f"{name}: {results[name]['score']:g}/{results[name]['max_score']:g}")

        work = partial(score, limits=_limits(options))
        stopped = take_each(map_in_order(work, left, options.jobs, in_order=False), take)
    if stopped:
        file = options.resume or "the file that has these rows"
        tell(f"{len(results)} of {len(left)} are scored; to continue, add --resume {file}")
        raise stopped
    if table is None:
        print_result(options.output, {"hand_ins": results}, "")


class _Table:
    """The table of a class: on stdout, or a file that gets the rows which it lacks.

    Attributes:
        known: The hand-ins whose rows are there. Rows that are not valid or not whole are dropped.
    """

    def __init__(self, path: Path | None, heads: Sequence[str], stack: ExitStack) -> None:
        """Write the head; `path` is the file, which may not exist yet, None: stdout."""
        from cloudrc.studies.exercise.score import csv_line, read_table

        self._file, rows = None, list[list[str]]()
        if path and path.exists():
            data = read_file(path, f"--resume {path}", "name the table of an earlier call")
            try:
                rows = read_table(data.decode("utf-8-sig"), heads)
            except ValueError as error:
                raise BadInputError(f"--resume {path}: {error}; name another file") from None
        self.known = {row[0] for row in rows}
        lines = [csv_line(row) for row in (heads, *rows)]
        if path:
            write_atomically(path, "".join(f"{line}\n" for line in lines).encode())
            self._file = stack.enter_context(path.open("a", encoding="utf-8"))
        else:
            print_lines(lines)

    def write(self, line: str) -> None:
        """Add a row, so that it stays whatever happens later."""
        print_line(line, self._file)


def _names_of(folders: Sequence[Path]) -> list[str]:
    """Return the name of each folder; if two are equal, the paths below the folder of all."""
    names = [folder.name for folder in folders]
    if len(set(names)) == len(names):
        return names
    shared = os.path.commonpath(folders)
    return [str(folder.relative_to(shared)) for folder in folders]


def _check_files(given: Path, folder: Path, names: Sequence[str]) -> None:
    """Check that a folder has files of a student."""
    from cloudrc.studies.exercise.files import describe_missing

    if not any((folder / name).exists() for name in names):
        hint = describe_missing(folder, names) or "name the folder that 'cloudrc class new' made"
        raise BadInputError(f"{given}: has none of {', '.join(names)}; {hint}")
