"""`cloudrc class`: hand out and score a task, by default the exercise of docs/exercise.md.

The students' functions run in a process of their own for each part of the task, so that a crash
costs the points of this part only. The process is no sandbox: a student's file has all rights of
the user.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING, Any

from cloudrc.cli.output import format_document, output_argument, print_line, print_result, tell
from cloudrc.cli.parser import Options, Parser, add_verbs, flags, read_count, read_size
from cloudrc.errors import BadInputError
from cloudrc.exercise.watch import LIMITS, Limits
from cloudrc.outside.paths import check_there

if TYPE_CHECKING:
    from cloudrc.config.task import Task

VERBS = {"new": "write the files that students fill in", "check": "score students' files"}
EPILOG = """\
examples:
  cloudrc class new exercise        three files to fill in
  cloudrc class check exercise      the points of each part
  cloudrc class new TASK.yaml       a task of your own, see docs/exercise.md
  cloudrc class check hand-ins/* --task TASK.yaml > points.csv
  cloudrc class check /autograder/submission -o gradescope > results.json

'check' runs the files in DIR with all your rights; it is no sandbox."""
JOBS_MAX = 1000


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    new, check = add_verbs(parser, VERBS).values()
    flags(new)(
        "task", "TASK", "file of your own task (.yaml), beside the files to fill in", nargs="?"
    )
    flags(new)("folder", "DIR", "folder for the files (default: named as TASK)")
    check.add_argument("folders", metavar="DIR", nargs="+", type=Path, help="folder with the files")
    add = flags(check)
    about = "the task (default: task.yaml in DIR, or else the exercise)"
    add("--task", "TASK", about, None, Path)
    add("--jobs", "N", "hand-ins at once (default: one per usable core)", JOBS_MAX, read_count)
    about = "memory of a part and its children together (default: 2Gi)"
    add("--memory", "SIZE", about, LIMITS.memory, read_size)
    about = f"processes of a part at once (default: {LIMITS.processes})"
    add("--processes", "N", about, LIMITS.processes, read_count)
    output_argument(check, "output format, csv for several DIR", forms=("gradescope", "csv"))


def execute(options: Options) -> None:
    """Write a student's files, or score the files in folders; return 0 whatever the score."""
    if options.verb == "new":
        _new(options.task, options.folder)
        return
    folders = [folder for folder in options.folders if folder.is_dir()]
    for other in options.folders:
        if other not in folders:
            if len(options.folders) == 1:
                check_there(other, "'cloudrc class new' makes one")
            tell(f"{other}: no folder; left out")
    if len(options.folders) > 1 or options.output == "csv":
        _check_all(options, folders)
    elif folders:
        _check(options, folders[0])


def _new(task: str | None, folder: Path) -> None:
    from cloudrc.exercise.files import SHIPPED, write_files

    if task is None and folder.suffix in (".yaml", ".yml"):
        task, folder = str(folder), Path(folder.stem)
    source = Path(task) if task else SHIPPED
    read, needed = _read(source), set[Path]()
    if source != SHIPPED:
        from cloudrc.exercise.checks import needed_files

        beside = source.resolve().parent
        needed = needed_files(read, beside)
        if outside := [file for file in needed if not file.is_relative_to(beside)]:
            raise BadInputError(f"{source}: a flight needs {outside[0]}; put it beside the task")
    names = write_files(folder, source, needed)
    command = f"cloudrc class check {quote(str(folder))}"
    print_line(f"fill in {', '.join(names)} in {folder}, then: {command}")


def _read(source: Path) -> Task:
    """Read a task, and check the flights of a lecturer's own."""
    from cloudrc.config.task import read_task
    from cloudrc.exercise.files import SHIPPED

    task = read_task(source)
    if source != SHIPPED:
        from cloudrc.exercise.checks import check_flights

        check_flights(task, source.resolve().parent)
    return task


def _limits(options: Options) -> Limits:
    return Limits(memory=int(options.memory), processes=options.processes)


def _check(options: Options, folder: Path) -> None:
    """Score a hand-in, and show each test as it ends."""
    from cloudrc.cli.progress import Progress
    from cloudrc.exercise import score
    from cloudrc.exercise.files import task_of
    from cloudrc.exercise.scoring import check

    source = task_of(folder, options.task)
    task = _read(source)
    if options.output != "gradescope":  # there, a hand-in without the files gets 0 points
        _check_files(folder, [*task.files.values()])
    rows = []
    with Progress(f"scores {folder}") as view:
        view.say(f"scores {folder}")
        for row in check(folder.resolve(), source.resolve(), _limits(options)):
            rows.append(row)
            view.say(f"  {row['part']}, {row['test']}: {row['points']:g}/{row['max_points']}")
    result = score.sum_up(rows)
    forms = {"gradescope": format_document(score.for_gradescope(result), "json")}
    print_result(options.output, result, score.as_text(result), **forms)


def _check_all(options: Options, folders: Sequence[Path]) -> None:
    """Score several hand-ins at once."""
    from cloudrc.cli.progress import Progress
    from cloudrc.exercise.score import as_csv
    from cloudrc.exercise.scoring import score
    from cloudrc.trials.workers import map_in_order

    if options.output == "gradescope":
        raise BadInputError("-o gradescope: give one DIR")
    task = options.task and options.task.resolve()
    if task:
        _read(task)
    results = dict[str, Any]()
    work = list(dict.fromkeys(folder.resolve() for folder in folders))
    with Progress(f"scores {len(work)} hand-ins") as view:
        for name, result in zip(
            _names_of(work),
            map_in_order(partial(score, task, limits=_limits(options)), work, options.jobs),
            strict=True,
        ):
            results[name] = result
            view.say(f"{name}: {result['score']:g}/{result['max_score']:g}")
    print_result(options.output, {"hand_ins": results}, as_csv(results), csv=as_csv(results))


def _names_of(folders: Sequence[Path]) -> list[str]:
    """Return the name of each folder; if two are equal, the paths below the folder of all."""
    names = [folder.name for folder in folders]
    if len(set(names)) == len(names):
        return names
    shared = os.path.commonpath(folders)
    return [str(folder.relative_to(shared)) for folder in folders]


def _check_files(folder: Path, names: Sequence[str]) -> None:
    """Check that a folder has files of a student."""
    from cloudrc.exercise.files import describe_missing

    if not any((folder / name).exists() for name in names):
        hint = describe_missing(folder, names) or "name the folder that 'cloudrc class new' made"
        raise BadInputError(f"{folder}: has none of {', '.join(names)}; {hint}")
