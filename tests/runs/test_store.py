"""Rows survive a crash, a folder has one sweep, and tables follow the grid's order."""

import csv
import json
import os
from math import nan

import pytest

from cloudrc.errors import BadInputError
from cloudrc.runs import store
from cloudrc.runs.grid import read_grid
from cloudrc.source import code_hash
from tests.runs.conftest import GRID, flown


@pytest.fixture
def grid(write_sweep):
    return read_grid(write_sweep())


@pytest.fixture
def rows(grid):
    """Four rows in the order of the grid; the last one lacks a number."""
    numbers = [{"duration": n + 0.1} for n in range(3)]
    pairs = zip(grid.flights.values(), [*numbers, {}], strict=True)
    return [flight.row(flown(**found)) for flight, found in pairs]


def test_rows_of_two_codes_are_told_with_both_hashes(grid, rows, tmp_path, caplog):
    store.begin(tmp_path, grid)
    write(tmp_path, rows[:2])
    assert store.read_flights(tmp_path)
    assert caplog.messages == []
    write(tmp_path, [{**row, "code": "0ther"} for row in rows[2:]], 2)  # copied from elsewhere
    store.read_flights(tmp_path)
    (said,) = caplog.messages
    assert f"{tmp_path}: its flights are of different code: " in said
    assert {code_hash(), "0ther"} <= {*said.split()}


def write(folder, rows, shard=None):
    with store.append_rows(folder, shard) as append:
        for row in rows:
            append(row)


def test_the_table_has_the_order_of_the_grid(grid, rows, tmp_path):
    tables = []
    for order, shards in (([0, 1, 2, 3], (None, None)), ([3, 1, 0, 2], (1, 2))):
        folder = tmp_path / str(shards[0])
        folder.mkdir()
        assert store.begin(folder, grid) == {}
        write(folder, [rows[n] for n in order[:2]], shards[0])
        assert len(store.finish(folder, grid)) == 2
        assert not (folder / "table.csv").exists()
        write(folder, [rows[n] for n in order[2:]], shards[1])
        assert len(store.finish(folder, grid)) == 4
        tables.append((folder / "table.csv").read_bytes())
    assert tables[0] == tables[1]
    head, first, *_, last = csv.reader(tables[0].decode().splitlines())
    names = ["seed", "verdict", "failures", "code", "physics_steps", "duration [s]"]
    assert head[1:] == [*grid.axes, *names]
    own = [code_hash(), "Python"]
    assert first == [rows[0]["key"], "last_sample", "40", "1", "success", "", *own, "0.1"]
    assert last[1:] == ["constant_velocity", "0", "1", "success", "", *own, ""]
    summary = store.read_summary(folder)
    assert (summary["counts"], summary["flights"]) == ({"success": 4}, 4)
    assert (summary["axes"], summary["seeds"]) == (grid.axes, [1])
    assert "link.profile=paper-p3" in summary["overrides"]


def test_half_a_line_is_dropped(rows, tmp_path):
    write(tmp_path, rows[:2])
    path = tmp_path / "rows.jsonl"
    whole = path.read_bytes()
    path.write_bytes(whole[:-5])
    assert list(store.read_rows(tmp_path)) == [rows[0]["key"]]
    write(tmp_path, rows[1:2])
    assert path.read_bytes() == whole
    assert list(store.read_rows(tmp_path).values()) == rows[:2]


def test_a_line_that_is_no_row_is_named(rows, tmp_path):
    write(tmp_path, rows[:1])
    for line in ("{", "[]", "{}", "3", '{"key": "a"}'):
        (tmp_path / "rows-2.jsonl").write_text(f"{json.dumps(rows[1])}\n{line}\n")
        with pytest.raises(BadInputError, match=r"rows-2.jsonl:2: is not a row of a sweep"):
            store.read_rows(tmp_path)


def test_rows_that_an_editor_saved_with_a_byte_order_mark_are_read(rows, tmp_path):
    write(tmp_path, rows[:2])
    path = tmp_path / "rows.jsonl"
    path.write_text(path.read_text(), "utf-8-sig", newline="\r\n")
    assert list(store.read_rows(tmp_path).values()) == rows[:2]
    write(tmp_path, rows[2:])
    assert list(store.read_rows(tmp_path).values()) == rows


def _make_folder(path):
    path.mkdir()


BROKEN = {
    "folder": (_make_folder, "Is a directory"),
    "pipe": (os.mkfifo, "it is not a file"),
    "device": (lambda path: path.symlink_to("/dev/zero"), "it is not a file"),
    "dangling": (lambda path: path.symlink_to("lost"), "No such file"),
    "long": (lambda path: path.write_bytes(b"0" * 3_000_000), "a line above 1048576 bytes"),
    "binary": (lambda path: path.write_bytes(b"\0\xff\n"), ":1: is not a row"),
    "UTF-16": (
        lambda path: path.write_text('{"key": 1}', "utf-16"),
        "is saved as UTF-16; save it as UTF-8$",
    ),
    "nested": (lambda path: path.write_bytes(b"[" * 100_000 + b"\n"), ":1: is not a row"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_what_is_no_file_of_rows_is_refused_at_once(kind, tmp_path):
    make, said = BROKEN[kind]
    make(tmp_path / "rows.jsonl")
    with pytest.raises(BadInputError, match=rf"rows\.jsonl.*{said}"):
        store.read_rows(tmp_path)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"numbers": []}, {"numbers": {"x": "1"}}, {"numbers": {"x": nan}}, {"point": None}),
        *({"seed": "1"}, {"seed": True}, {"failures": "x"}, {"verdict": None}, {"key": 1}),
    ],
)
def test_a_row_with_a_field_of_another_type_is_no_row(wrong, rows):
    assert store.parse_row(json.dumps(rows[0])) == rows[0]
    assert store.parse_row(json.dumps(rows[0] | wrong)) is None


@pytest.mark.parametrize("point", [{}, {"other": 1}, {"link.both.delay_ms": 7}])
def test_rows_of_another_grid_are_refused(point, grid, rows, tmp_path):
    store.begin(tmp_path, grid)
    write(tmp_path, [rows[0] | {"point": point if "other" in point or not point
                                else rows[0]["point"] | point}])  # fmt: skip
    with pytest.raises(BadInputError, match="has another point than those in"):
        store.read_flights(tmp_path)


@pytest.mark.parametrize(
    "text", ["[]", "{}", '{"axes": 3, "flights": 1, "units": {}}', "[" * 100_000, "\0", "NaN"]
)
def test_what_is_no_description_of_a_sweep_is_refused(text, tmp_path):
    (tmp_path / "sweep.json").write_text(text)
    with pytest.raises(BadInputError, match="is not a folder of"):
        store.read_summary(tmp_path)


def test_a_folder_holds_one_sweep(grid, rows, write_sweep, tmp_path):
    store.begin(tmp_path, grid)
    write(tmp_path, rows)
    store.finish(tmp_path, grid)
    store.begin(tmp_path, grid)
    assert (tmp_path / "table.csv").is_file()
    more = read_grid(write_sweep(seeds=2))  # more flights are no other sweep
    assert list(store.begin(tmp_path, more).values()) == rows
    assert not (tmp_path / "table.csv").exists()  # it has fewer flights than sweep.json says
    other = read_grid(write_sweep({"link.both.delay_ms": [7]}))
    with pytest.raises(
        BadInputError, match=r"has another sweep, see sweep\.yaml; name a new folder"
    ):
        store.begin(tmp_path, other)


def test_another_sweep_is_refused_before_the_first_row(write_sweep, tmp_path):
    store.begin(tmp_path, read_grid(write_sweep(seeds=2)))
    before = (tmp_path / "sweep.yaml").read_bytes()
    for axes, seeds in ((GRID, 1), ({"link.both.delay_ms": [7]}, 2)):
        with pytest.raises(BadInputError, match="has another sweep"):
            store.begin(tmp_path, read_grid(write_sweep(axes, seeds)))
    assert (tmp_path / "sweep.yaml").read_bytes() == before


def test_the_comments_of_a_user_stay_in_the_file_of_the_sweep(write_sweep, tmp_path):
    path, file = write_sweep(), tmp_path / "sweep.yaml"
    store.begin(tmp_path, read_grid(path))
    commented = f"# mine\n{file.read_text()}"
    file.write_text(commented)
    store.begin(tmp_path, read_grid(path))
    with pytest.raises(BadInputError, match="edited by hand"):
        store.begin(tmp_path, read_grid(write_sweep(seeds=9)))
    assert file.read_text() == commented


@pytest.mark.parametrize("changed", ["mine.py", "helper.py"])
def test_a_changed_plugin_is_not_mixed_with_rows_of_the_old_one(write_sweep, tmp_path, changed):
    (tmp_path / "mine.py").write_text("from helper import build\n")
    (tmp_path / "helper.py").write_text("from cloudrc.cloud.predictors.last_sample import build\n")
    path = write_sweep({"cloud.predictor": ["./mine.py"]})
    (flight,) = read_grid(path).flights.values()
    write(tmp_path, [flight.row(flown())])
    assert list(store.begin(tmp_path, read_grid(path))) == [flight.key]
    with (tmp_path / changed).open("a") as file:
        file.write("# changed\n")
    with pytest.raises(BadInputError, match=rf"changed since its flights: {tmp_path / changed};"):
        store.begin(tmp_path, read_grid(path))
    summary = json.loads((tmp_path / "sweep.json").read_text())
    del summary["files"]  # as in a folder of an earlier version
    (tmp_path / "sweep.json").write_text(json.dumps(summary))
    with pytest.raises(BadInputError, match="or a file that it names has changed since"):
        store.begin(tmp_path, read_grid(path))


def test_other_code_flies_nothing_into_the_folder(grid, rows, tmp_path, monkeypatch):
    """Both hashes are named, so that the user finds the code of the flights."""
    store.begin(tmp_path, grid)
    write(tmp_path, rows[:1])
    monkeypatch.setattr(store, "code_hash", lambda: "0123456789abcdef")
    said = f"its flights are of code {code_hash()}, this is code 0123456789abcdef"
    for is_shared in (False, True):
        with pytest.raises(BadInputError, match=said):
            store.begin(tmp_path, grid, is_shared=is_shared)


def test_shards_of_other_code_are_refused_before_the_first_row(grid, tmp_path, monkeypatch):
    store.begin(tmp_path, grid, is_shared=True)
    monkeypatch.setattr(store, "code_hash", lambda: "0123456789abcdef")
    with pytest.raises(BadInputError, match=f"{code_hash()}, this is code 0123456789abcdef"):
        store.begin(tmp_path, grid, is_shared=True)
    store.begin(tmp_path, grid)  # no other process flies into this folder, and it has no row


def test_a_folder_from_before_the_hash_is_read_but_not_continued(grid, rows, tmp_path):
    store.begin(tmp_path, grid)
    for row in rows:
        del row["code"], row["physics_steps"]
    write(tmp_path, rows)
    found, units, missing = store.read_flights(tmp_path)
    assert (len(found), units["duration"], missing) == (4, "s", "")
    with pytest.raises(BadInputError, match=r"of code without a hash, of an earlier version"):
        store.begin(tmp_path, grid)


def test_another_folder_is_refused(tmp_path):
    with pytest.raises(BadInputError, match="is not a folder of"):
        store.read_summary(tmp_path)


def test_equal_values_of_an_axis_are_one_value_also_lists_and_mappings():
    assert store.frozen([0, {"a": [1.0]}]) == store.frozen([0.0, {"a": [1]}])
    assert len({*map(store.frozen, [[0, 1], [1, 0], {"a": 1}, {"a": 2}, None, "a"])}) == 6
