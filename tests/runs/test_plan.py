"""One shard checks all points of a sweep; the others check their own, and fly no other flights."""

import errno
import fcntl
import json
import os
import shutil
from contextlib import ExitStack

import pytest

from cloudrc.errors import BadInputError
from cloudrc.runs import grid as grids
from cloudrc.runs import store, sweep
from cloudrc.runs.grid import read_grid, read_unchecked
from cloudrc.runs.lock import lock_plan
from cloudrc.runs.plan import check_shard
from tests.runs.conftest import GRID, flown

MORE = GRID | {"link.both.delay_ms": [40, 0, 20]}


@pytest.fixture
def folder(tmp_path):
    """The folder of a sweep."""
    folder = tmp_path / "sweep"
    folder.mkdir()
    return folder


@pytest.fixture
def loads(monkeypatch):
    """Count the points that are resolved."""
    real, seen = grids.load_experiment, []
    monkeypatch.setattr(grids, "load_experiment", lambda *given: seen.append(1) or real(*given))
    return seen


@pytest.fixture
def check(folder, loads):
    """Return a function that checks a shard; return its grid and the number of resolved points."""

    def run(path, shard=1, count=4, **words):
        loads.clear()
        found = check_shard(read_unchecked(path), folder, shard, count, **words)
        return found, len(loads)

    return run


def fly(folder, found, shard, count):
    """Write the rows of a shard's flights."""
    work = sweep.begin(found, folder, shard, count)
    with store.append_rows(folder, shard) as append:
        for flight in work.missing:
            append(flight.row(flown(duration=float(flight.seed))))
    store.finish(folder, found)


@pytest.mark.parametrize("seeds", [1, 3])
@pytest.mark.parametrize("count", [1, 2, 5, 7, 13])
def test_a_later_shard_resolves_only_the_points_of_its_flights(
    seeds, count, write_sweep, check, folder
):
    path = write_sweep(seeds=seeds)
    whole = read_grid(path)
    assert check(path, 1, count)[1] == 4
    for shard in range(count, 0, -1):
        own = [*whole.flights.values()][shard - 1 :: count]
        found, resolved = check(path, shard, count)
        assert resolved == len({json.dumps(flight.point) for flight in own})
        assert (found.point_of, found.name) == (whole.point_of, "steps")
        assert sweep.begin(found, folder, shard, count).mine == own
        fly(folder, found, shard, count)
    summary, table = store.read_summary(folder), (folder / "table.csv").read_bytes()
    assert len(table.splitlines()) == 1 + 4 * seeds
    store.finish(folder, whole)
    assert (folder / "table.csv").read_bytes() == table
    assert store.read_summary(folder) == summary


def test_the_progress_of_a_later_shard_is_that_of_its_own_points(write_sweep, check):
    seen, path = [], write_sweep()
    check(path)
    check(path, 2, see=lambda *counts: seen.append(counts))
    assert seen == [(0, 1, "1 of 4 points"), (1, 1, "1 of 4 points")]


@pytest.fixture
def other(folder):
    """Another shard that checks all points, until the stack is closed."""
    with ExitStack() as stack:
        stack.enter_context(lock_plan(folder, pytest.fail))
        yield stack


def test_shards_that_start_at_once_wait_for_the_one_that_checks_all_points(
    write_sweep, check, folder, tmp_path, other
):
    path, said = write_sweep(seeds=2), []
    shutil.copytree(folder, tmp_path / "ready")
    check_shard(read_unchecked(path), tmp_path / "ready", 1, 8)

    def wait(work):
        said.append(work)
        if len(said) == 3:
            shutil.copytree(tmp_path / "ready", folder, dirs_exist_ok=True)
            other.close()

    assert check(path, 8, 8, wait=wait)[1] == 1
    assert said == ["4 points x 2 seeds: 8 flights"] * 3


def test_another_shard_checks_all_points_if_the_first_one_is_killed(write_sweep, check, other):
    path = write_sweep()
    assert check(path, 2, wait=lambda work: other.close())[1] == 4  # its end frees the lock
    assert check(path, 3)[1] == 1


def test_shards_of_a_wrong_sweep_do_not_wait_for_each_other(folder, other):
    """Once the first one is refused. Else each of hundred shards would wait for all the others."""
    waited = []

    def wait_once():
        assert waited == []
        waited.append(1)

    with lock_plan(folder, other.close), lock_plan(folder, wait_once):
        assert waited == [1]


def test_without_locks_no_shard_waits(write_sweep, check, folder, monkeypatch, other):
    def refuse(file, how):
        raise OSError(errno.ENOLCK, "refused")

    path = write_sweep()
    monkeypatch.setattr(fcntl, "flock", refuse)
    assert check(path, 2, wait=pytest.fail)[1] == 4
    assert check(path, 3)[1] == 1


def test_a_shard_keeps_what_the_summary_says_about_other_points(
    write_sweep, check, folder, tmp_path
):
    text = '"""A metric."""\nUNIT = "m"\ndef measure(flight):\n    return 1.0\n'
    (tmp_path / "mine.py").write_text(text)
    path = write_sweep({"report.metrics": [["./mine.py"], []]})
    check(path, 1, 2)
    before = store.read_summary(folder)
    fly(folder, check(path, 2, 2)[0], 2, 2)
    after = store.read_summary(folder)
    assert (after["units"]["mine"], [*after["files"]]) == ("m", [str(tmp_path / "mine.py")])
    assert before == after | {"counts": {}}


@pytest.mark.parametrize("changed", ["mine.py", "helper.py"])
def test_a_file_that_changes_between_two_shards_is_named(write_sweep, check, tmp_path, changed):
    (tmp_path / "mine.py").write_text("from helper import build\n")
    (tmp_path / "helper.py").write_text("from cloudrc.cloud.predictors.last_sample import build\n")
    path = write_sweep({"cloud.predictor": ["./mine.py", "last_sample"]})
    check(path, 1, 2)
    with (tmp_path / changed).open("a") as file:
        file.write("# changed\n")
    check(path, 2, 2)  # its flights do not have the file
    with pytest.raises(BadInputError, match=f"its flights: {tmp_path / changed}; name a new"):
        check(path, 1, 2)


def test_a_changed_experiment_is_refused(write_sweep, check, tmp_path):
    (tmp_path / "mine.yaml").write_text("criteria: {time_limit_s: 40}\n")
    path = write_sweep(experiment="./mine.yaml", set={})
    check(path)
    (tmp_path / "mine.yaml").write_text("criteria: {time_limit_s: 50}\n")
    with pytest.raises(BadInputError, match=r"has changed since plan.json was written; name a new"):
        check(path, 2)


def test_a_shard_of_other_code_is_refused_before_it_checks_a_point(
    write_sweep, check, folder, monkeypatch, loads
):
    path = write_sweep()
    check(path)
    before = (folder / store.PLAN).read_bytes()
    for place in ("source", "runs.store"):
        monkeypatch.setattr(f"cloudrc.{place}.code_hash", lambda: "0123456789abcdef")
    with pytest.raises(BadInputError, match="this is code 0123456789abcdef"):
        check(path, 2)
    assert loads == []
    assert (folder / store.PLAN).read_bytes() == before


def test_a_shard_of_another_sweep_is_refused_and_leaves_the_plan(write_sweep, check, folder):
    check(write_sweep())
    before = (folder / store.PLAN).read_bytes()
    with pytest.raises(BadInputError, match="has another sweep"):
        check(write_sweep({"link.both.delay_ms": [7]}), 2)
    assert (folder / store.PLAN).read_bytes() == before


def test_a_larger_grid_replaces_the_plan(write_sweep, check, folder):
    for axes, first, second in ((GRID, 4, 2), (MORE, 6 + 4, 3)):  # all flights stay in the grid
        path = write_sweep(axes)
        for shard, points in ((1, first), (2, second)):
            found, resolved = check(path, shard, 2)
            assert resolved == points
            fly(folder, found, shard, 2)
    assert len((folder / "table.csv").read_text().splitlines()) == 7
    with pytest.raises(BadInputError, match="has another sweep"):
        check(write_sweep(), 2, 2)


def edited(**words):
    return lambda path: path.write_text(json.dumps(json.loads(path.read_text()) | words))


def make_pipe(path):
    path.unlink()
    os.mkfifo(path)


UNUSABLE = {
    "missing": lambda path: path.unlink(),
    "empty": lambda path: path.write_bytes(b""),
    "half": lambda path: path.write_bytes(path.read_bytes()[:40]),
    "binary": lambda path: path.write_bytes(b"\0\xff"),
    "nested": lambda path: path.write_bytes(b"[" * 100_000),
    "list": lambda path: path.write_bytes(b"[]"),
    "pipe": make_pipe,
    "other code": edited(code="0123456789abcdef"),
    "other sweep": edited(sweep="0"),
    "numbers": edited(keys=[1, 2, 3, 4]),
    "short": edited(keys=["a", "b", "c"]),
    "double": edited(keys=["a", "b", "c", "c"]),
}


@pytest.mark.parametrize("kind", UNUSABLE)
def test_a_plan_that_cannot_be_used_is_made_again(kind, write_sweep, check, folder):
    """A folder of an earlier version has none."""
    path = write_sweep()
    found, _ = check(path, 1, 2)
    fly(folder, found, 1, 2)
    plan = folder / store.PLAN
    before = plan.read_bytes()
    UNUSABLE[kind](plan)
    assert check(path, 2, 2)[1] == 4
    assert plan.read_bytes() == before
    assert check(path, 2, 2)[1] == 2


def test_a_plan_with_other_keys_never_gives_other_rows(write_sweep, check, folder):
    path = write_sweep()
    found, _ = check(path, 1, 2)
    fly(folder, found, 1, 2)
    first, second, *others = found.point_of
    plan = folder / store.PLAN
    edited(keys=[first, "b", *others])(plan)
    with pytest.raises(BadInputError, match=r"has changed since plan.json was written"):
        check(path, 2, 2)
    edited(keys=["a", second, *others])(plan)
    wrong, _ = check(path, 2, 2)
    with pytest.raises(BadInputError, match=r"has flights that are not in sweep.yaml"):
        sweep.begin(wrong, folder, 2, 2)


def test_the_file_of_the_sweep_may_have_another_place_in_each_shard(
    write_sweep, check, folder, tmp_path
):
    path, other = write_sweep(), tmp_path / "other"
    check(path)
    before = (folder / store.FILE).read_bytes()
    other.mkdir()
    found, resolved = check(shutil.copy(path, other / "grid.yaml"), 2)
    fly(folder, found, 2, 4)
    assert resolved == 1
    assert (folder / store.FILE).read_bytes() == before


def test_flights_without_shards_leave_no_plan(write_sweep, check, folder, tmp_path):
    """They may be those of a changed file, because no other process flies at the same time."""
    (tmp_path / "mine.py").write_text("from cloudrc.cloud.predictors.last_sample import build\n")
    path = write_sweep({"cloud.predictor": ["./mine.py"]}, seeds=2)
    check(path)
    (tmp_path / "mine.py").write_text("from cloudrc.cloud.predictors.kalman import build\n")
    fly(folder, read_grid(path), None, 1)
    assert check(path, 2)[1] == 1
