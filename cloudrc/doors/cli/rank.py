# SPDX-License-Identifier: Apache-2.0

"""`cloudrc rank`: rank policies over networks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.paths import lock_folder
from cloudrc.base.outside.refusal import check_names
from cloudrc.base.requirements import require
from cloudrc.base.text import escape, table
from cloudrc.doors.cli.output import tell
from cloudrc.doors.cli.parser import COUNT_MAX, Options, Parser, read_count
from cloudrc.doors.cli.sweep import shard
from cloudrc.flight.folder import RUNS

if TYPE_CHECKING:
    from cloudrc.studies.rank.tasks import Entrant

EPILOG = """\
examples:
  cloudrc rank --task linear --task cartpole
  cloudrc rank --task reach-v3 --policy ws://gpu:8000 -o entries/mine.json
  cloudrc rank --task gap --policy ./perception.py
  cloudrc rank page entries/*.json

Without --policy, the policies that come with the tasks play. Each plays 16
conditions with 50 seeds. The same call plays only what is missing.
docs/ranking.md describes tasks and score."""


def arguments(parser: Parser) -> None:
    """Declare the command's arguments, and the verb `page`."""
    about = "a task; repeatable (default: all that are installed, without follow)"
    parser.add_argument("--task", action="append", default=[], metavar="NAME", help=about)
    about = "a shipped policy, a Python file, or the address of a server; repeatable"
    parser.add_argument("--policy", action="append", default=[], metavar="POLICY", help=about)
    about = "how the robot executes the answers (default: newest, or that of a shipped policy)"
    parser.add_argument("--executor", metavar="NAME", help=about)
    about = "folder of the entries, or .json for a single one (default: runs/rank)"
    parser.add_argument("-o", "--out", type=Path, default=RUNS / "rank", metavar="PATH", help=about)
    about = "parallel processes for a policy in a file (default: one per core)"
    parser.add_argument("--jobs", type=read_count, default=COUNT_MAX, metavar="N", help=about)
    about = "play part I of N of the episodes; the call without it writes the entries"
    parser.add_argument("--shard", type=shard, metavar="I/N", help=about)
    verbs = parser.add_subparsers(dest="verb", metavar="[page]", title="verb")
    about = "make a page with the tables of entries"
    page = verbs.add_parser("page", help=about, description="Make a page with tables of entries.")
    page.add_argument("entries", nargs="+", type=Path, metavar="FILE", help="files of entries")
    about = "file of the page (default: index.html beside the first entry)"
    page.add_argument("-o", "--out", type=Path, dest="page", metavar="FILE", help=about)


def make_page(path: Path, entries: list[Path]) -> None:
    """Check the entries, write the page, and print its path."""
    from cloudrc.studies.rank.page import write_page

    write_page(path, entries)
    print(escape(str(path)))


def execute(options: Options) -> None:
    """Play what is missing, write the entries and their page, and print the table."""
    require("a ranking", ["gym"])
    if options.verb:
        make_page(options.page or options.entries[0].parent / "index.html", options.entries)
        return
    entrants = _entrants(options)
    is_file = options.out.suffix == ".json"
    if is_file and len(entrants) > 1:
        raise BadInputError(f"-o {options.out}: {len(entrants)} entries do not fit into a file")
    folder = options.out.parent if is_file else options.out
    folder.mkdir(parents=True, exist_ok=True)
    files = {each: options.out if is_file else folder / f"{each.name}.json" for each in entrants}
    found = dict[Path, Mapping[str, Any]]()
    with lock_folder(folder, options.shard):
        for entrant, path in files.items():
            if entry := _play(entrant, path, options):
                found[path] = entry
    names = ("task", "policy", "executor", "score", "area")
    rows = [tuple(str(each[name]) for name in names) for each in found.values()]
    if rows:
        print(table([names, *rows], right=[3, 4]))
    if is_file:
        print(escape(str(options.out)))
    elif found:
        make_page(folder / "index.html", [*found])


def _entrants(options: Options) -> list[Entrant]:
    """Return who plays what; without a name, leave out what is not installed, and say so."""
    from cloudrc.doors.cli.eval_values import check_policy
    from cloudrc.studies.rank.tasks import TASKS, Entrant, shipped

    check_names("task", options.task, TASKS, "--task: ")
    if options.policy and not options.task:
        raise BadInputError(f"--policy: name its task with --task: {', '.join(TASKS)}")
    found = [*shipped(options.task or [name for name, each in TASKS.items() if each.is_usual])]
    if not options.task:
        for each in [each for each in found if each.lacking]:
            told = f"needs cloudrc[{','.join(each.lacking)}], which is not installed"
            tell(f"left out: {each.policy} plays {each.task}, which {told}")
        found = [each for each in found if not each.lacking]
    if options.policy:
        ours, found = found, list[Entrant]()
        for task, policy in product(options.task, options.policy):
            same = [each for each in ours if (each.task, each.policy) == (task, policy)]
            if not same and TASKS[task].env:
                check_policy(policy)
            found += same or [Entrant(task, policy, TASKS[task].usual_executor)]
    if options.executor:
        for each in found:
            check_names("executor", [options.executor], TASKS[each.task].executors, "--executor: ")
        found = [*dict.fromkeys(replace(each, executor=options.executor) for each in found)]
    for each in found:
        require(f"{each.policy} in the task {each.task}", each.lacking)
    return found


def _play(entrant: Entrant, path: Path, options: Options) -> Mapping[str, Any] | None:
    """Play what is missing of an entry; write and return it, or None after a part of it.

    Raise a CloudrcError if the work ended early.
    """
    from cloudrc.doors.cli.progress import Progress
    from cloudrc.studies.policy.load import PolicyFailedError
    from cloudrc.studies.rank.play import Played

    with Progress(f"makes {entrant.name}"):
        played = Played(entrant, path)
    with Progress(f"plays {entrant.name}", len(played)) as view:
        try:
            if stopped := played.play(options.jobs, options.shard, view.count):
                tell("the same call goes on")
                raise stopped
        except PolicyFailedError as error:
            tell(f"{entrant.name}: {error}")
            return played.write(str(error))
        return None if options.shard else played.write()
