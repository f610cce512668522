"""Shards of one sweep fly into one folder, and mix nothing."""

import shutil

import pytest

from cloudrc.errors import BadInputError
from cloudrc.runs import store, sweep
from cloudrc.runs.grid import read_grid
from tests.runs.conftest import GRID, flown

MORE = GRID | {"link.both.delay_ms": [40, 0, 20]}


@pytest.fixture
def folder(tmp_path):
    """The folder of a sweep."""
    folder = tmp_path / "sweep"
    folder.mkdir()
    return folder


@pytest.fixture
def fly(folder):
    """Return a function that begins a shard, and returns one that writes the rows it lacks."""

    def begin(path, shard=1, count=2):
        found = read_grid(path)
        work = sweep.begin(found, folder, shard, count)

        def write():
            with store.append_rows(folder, shard) as append:
                for flight in work.missing:
                    append(flight.row(flown(duration=float(flight.seed))))
            store.finish(folder, found)

        return write

    return begin


def test_a_file_that_changes_between_two_shards_is_named(write_sweep, fly, tmp_path):
    (tmp_path / "mine.py").write_text("from helper import build\n")
    (tmp_path / "helper.py").write_text("from cloudrc.cloud.predictors.last_sample import build\n")
    path = write_sweep({"cloud.predictor": ["./mine.py", "last_sample"]})
    fly(path)()
    with (tmp_path / "helper.py").open("a") as file:
        file.write("# changed\n")
    with pytest.raises(BadInputError, match=f"its flights: {tmp_path / 'helper.py'}; name a new"):
        fly(path, 2)


def test_a_change_before_the_first_row_gives_no_table(write_sweep, fly, folder, tmp_path):
    """Both shards have begun, so neither sees the other's experiment before there are rows."""
    (tmp_path / "mine.yaml").write_text("criteria: {time_limit_s: 40}\n")
    path = write_sweep(experiment="./mine.yaml", set={})
    first = fly(path)
    (tmp_path / "mine.yaml").write_text("criteria: {time_limit_s: 50}\n")
    second = fly(path, 2)
    first()
    second()
    assert not (folder / store.TABLE).exists()
    with pytest.raises(BadInputError, match=r"has flights that are not in sweep\.yaml"):
        fly(path, 1)


def test_a_shard_of_other_code_is_refused(write_sweep, fly, monkeypatch):
    path = write_sweep()
    fly(path)
    for place in ("source", "runs.store"):
        monkeypatch.setattr(f"cloudrc.{place}.code_hash", lambda: "0123456789abcdef")
    with pytest.raises(BadInputError, match="this is code 0123456789abcdef"):
        fly(path, 2)


def test_a_shard_of_another_sweep_is_refused(write_sweep, fly):
    fly(write_sweep())
    with pytest.raises(BadInputError, match="has another sweep"):
        fly(write_sweep({"link.both.delay_ms": [7]}), 2)


def test_a_larger_grid_goes_on(write_sweep, fly, folder):
    for axes in (GRID, MORE):  # all flights stay in the grid
        for shard in (1, 2):
            fly(write_sweep(axes), shard)()
    assert len((folder / "table.csv").read_text().splitlines()) == 7
    with pytest.raises(BadInputError, match="has another sweep"):
        fly(write_sweep(), 2)


def test_the_file_of_the_sweep_may_have_another_place_in_each_shard(
    write_sweep, fly, folder, tmp_path
):
    path, other = write_sweep(), tmp_path / "other"
    fly(path)()
    before = (folder / store.FILE).read_bytes()
    other.mkdir()
    fly(shutil.copy(path, other / "grid.yaml"), 2)()
    assert (folder / store.FILE).read_bytes() == before
    assert (folder / store.TABLE).exists()
