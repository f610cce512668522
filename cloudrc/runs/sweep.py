"""Fly the flights of a sweep, keep their rows, and summarise them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.errors import BadInputError, CloudrcError, InvalidRunError
from cloudrc.runs import store
from cloudrc.runs.flight import Row, fly_point
from cloudrc.runs.fly import fly
from cloudrc.runs.folder import new_folder
from cloudrc.runs.grid import Grid, SweepPoint, read_flight
from cloudrc.runs.lock import lock_folder
from cloudrc.runs.own_files import hash_all
from cloudrc.runs.workers import map_in_order, take_each
from cloudrc.source import code_hash
from cloudrc.text import table


class Work(NamedTuple):
    """The flights that a command or a call has to do, of a sweep in a folder."""

    mine: list[SweepPoint]  # flights of this shard, or of the whole sweep
    missing: list[SweepPoint]  # those of them without a row, or without a wanted recording
    before: dict[str, Row]  # key -> row of the flights that are in the folder


@contextmanager
def open_folder(
    out: Path | None, name: str, shard: int | None = None, count: int = 1
) -> Iterator[tuple[Path, str]]:
    """Lock the folder of a sweep: `out`, or a new one in `runs/` whose name begins with `name`.

    `shard` is a number from 1 to `count`, or None for the whole sweep. Yield the folder, and a
    warning if it has no locks ("" for none).
    """
    if out is not None and shard and not out.exists():
        out.mkdir(parents=True, exist_ok=True)  # another shard may be faster
    elif out is None or not store.is_begun(out):
        out = new_folder(out, name, "latest-sweep", is_shared=bool(shard))
    folder = out
    with lock_folder(folder, shard, count) as warning:
        yield folder, warning


def begin(
    grid: Grid, folder: Path, shard: int | None = None, count: int = 1, record: str | None = None
) -> Work:
    """Begin or continue a sweep in `folder`, which is locked; return what has to be flown.

    `shard` is a number from 1 to `count`, or None for all flights. `record` names the flights to
    record: "failed", "all" or None for no flights. Raise a BadInputError if the folder has rows of
    another sweep or of other code.
    """
    before = store.begin(folder, grid, is_shared=bool(shard))
    mine = [grid.flights[key] for key in [*grid.point_of][(shard or 1) - 1 :: count]]
    missing = [
        each
        for each in mine
        if each.key not in before or _to_record(before[each.key], record, folder)
    ]
    return Work(mine, missing, before)


def fly_missing(work: Work, folder: Path, jobs: int, record: str | None = None) -> Generator[Row]:
    """Fly what is missing in `jobs` processes; yield each row once it is flown."""
    job = partial(fly_row, record=record, folder=folder)
    return map_in_order(job, work.missing, jobs, in_order=False)


def keep(
    flown: Generator[Row],
    folder: Path,
    grid: Grid,
    shard: int | None,
    before: Collection[str],
    see: Callable[[Row], None] = lambda row: None,
) -> tuple[dict[str, Row], CloudrcError | None]:
    """Append each new row to the sweep in `folder`, call `see` with it, and write the tables.

    `before` has the keys of the rows that the folder already has. Return all rows, key -> row; and
    why the work ended early, or None.
    """
    with store.append_rows(folder, shard) as append:

        def take(row: Row) -> None:
            if row["code"] != code_hash():
                raise BadInputError("the code of cloudrc has changed during the sweep; begin again")
            if row["key"] not in before:
                append(row)
            see(row)

        stopped = take_each(flown, take)
    try:
        return store.finish(folder, grid), stopped
    except OSError:
        if not stopped:
            raise
        return store.read_rows(folder), stopped  # the reason to tell is the first one


def fly_row(flight: SweepPoint, record: str | None = None, folder: Path = Path()) -> Row:
    """Fly a flight and return its row; if a recording is wanted, fly again to make it."""
    row = flight.row(fly_point(flight.experiment))
    if _to_record(row, record, folder):
        fly_into(folder / flight.key, flight, page=False)
    return row


def _to_record(row: Row, record: str | None, folder: Path) -> bool:
    """Return whether a flight still needs a recording.

    `record` names the flights to record: "failed", "all" or None for no flights.
    """
    wanted = record == "all" or (record == "failed" and row["verdict"] != "success")
    has = (folder / row["key"] / "report.json").is_file()
    return wanted and row["verdict"] != "error" and not has


def fly_into(folder: Path, flight: SweepPoint, *, page: bool) -> dict[str, Any]:
    """Fly a flight with a recording into its folder in a sweep; return the report."""
    folder.mkdir(exist_ok=True)
    (folder / "environment.json").unlink(missing_ok=True)  # it describes an earlier flight
    return fly(flight.experiment, "virtual", folder, page=page)


def find_flight(folder: Path, begin: str) -> tuple[Row, SweepPoint]:
    """Return the row of a sweep whose key begins like this, and the flight that repeats it.

    Raises:
        BadInputError: If no row, or more than one, has such a key; or if the flight would be
            another one, because code or files have changed.
    """
    store.read_summary(folder)
    rows = [row for key, row in store.read_rows(folder).items() if key.startswith(begin)]
    if len(rows) != 1:
        text = f"{len(rows)} rows have a key that begins like this; give one key"
        raise BadInputError(f"{folder}: {begin}: {text}")
    (row,), key = rows, rows[0]["key"]
    flight = read_flight(folder / store.FILE, row["point"], row["seed"])
    if flight is None or flight.key != key:
        code = row.get("code") or "without a hash"
        why = f"was flown by code {code}, this is code {code_hash()}"
        if code == code_hash():
            files = hash_all(flight.resolved) if flight else {}
            why = "the experiment or a file of a plug-in, trace, robot or scene has changed since"
            why = store.describe_changes(folder, files) or why
        raise BadInputError(f"{key}: {why}; fly the sweep again")
    return row, flight


def check_repeated(row: Row, report: Mapping[str, Any]) -> None:
    """Raise an InvalidRunError if the repeated flight of a row has other records."""
    if row["records_sha256"] != report["records_sha256"]:
        why = "other records, though no file of its key has changed: the processor or a package has"
        raise InvalidRunError(f"{row['key']}: {why}, or a plug-in uses what is in no key")


def count_successes(folder: Path) -> tuple[int, list[Row], list[dict[str, Any]]]:
    """Return the number of flights of a sweep, its rows, and the successes per value of an axis."""
    summary, rows = store.read_summary(folder), [*store.read_rows(folder).values()]
    store.check_points(folder, rows, summary["axes"])
    values = []
    for axis, choices in summary["axes"].items():
        of = [store.frozen(row["point"][axis]) for row in rows]
        flights = Counter(of)
        successes = Counter(of[n] for n, row in enumerate(rows) if row["verdict"] == "success")
        for value in choices:
            key = store.frozen(value)
            counts = {"flights": flights[key], "success": successes[key]}
            values.append({"axis": axis, "value": value, **counts})
    return summary["flights"], rows, values


def count_verdicts(rows: Iterable[Row]) -> str:
    """Return how many flights have which verdict, such as "9 success, 1 failure"."""
    numbers = Counter(row["verdict"] for row in rows)
    return ", ".join(f"{n} {verdict}" for verdict, n in sorted(numbers.items())[::-1]) or "none"


def status_text(flights: int, rows: Sequence[Row], values: Sequence[Mapping[str, Any]]) -> str:
    """Format the result of `count_successes` for people."""
    text = f"{len(rows)} of {flights} flights are done: {count_verdicts(rows)}"
    if not values:
        return text
    cells = [("axis", "value", "success")]
    for each in values:
        share = f"{each['success']}/{each['flights']}"
        cells.append((each["axis"], store.as_text(each["value"]), share))
    return f"{text}\n\n{table(cells, right=(2,))}"
