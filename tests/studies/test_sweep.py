# SPDX-License-Identifier: Apache-2.0

"""A folder has one sweep; its tables follow the order of the grid, whatever flew first."""

import csv
import json

import pytest

from cloudrc.base import source
from cloudrc.base.errors import BadInputError
from cloudrc.flight.trials.plan import read_plan
from cloudrc.studies import sweep
from tests.support.sweeps import flown

PLUG_IN = {
    "mine.py": "from helper import build\n",
    "helper.py": "from cloudrc.cloud.predictors.last_sample import build\n",
}


@pytest.fixture
def folder(tmp_path):
    """The folder of a sweep."""
    folder = tmp_path / "sweep"
    folder.mkdir()
    return folder


def made(plan):
    """Return the rows of a plan; the last one lacks a number."""
    numbers = [{"duration": n + 0.1} for n in range(len(plan.flights) - 1)]
    every = zip(plan.flights.values(), [*numbers, {}], strict=True)
    return [flight.row(flown(**found)) for flight, found in every]


def fly(path, folder, which=slice(None), shard=None):
    """Fly some of the flights that a folder lacks; return the plan."""
    plan = read_plan(path)
    rows = sweep.begin(folder, plan, shard)
    mine = {each.key for each in sweep.flights_of(plan, shard)}
    for row in made(plan)[which]:
        if row["key"] in mine:
            rows.add(row)
    sweep.finish(folder, plan)
    return plan


def test_the_table_has_the_order_of_the_grid(write_sweep, folder):
    path = write_sweep()
    for shard in ((2, 2), (1, 2)):
        assert not (folder / "table.csv").exists()
        plan = fly(path, folder, slice(None, None, -1), shard)
    head, first, *_, last = csv.reader((folder / "table.csv").read_text().splitlines())
    names = ["seed", "verdict", "failures", "code", "physics_steps", "duration [s]"]
    assert head[1:] == [*plan.axes, *names]
    own = [source.code_hash(), "Python"]
    key = next(iter(plan.flights))
    assert first == [key, "last_sample", "40", "1", "success", "", *own, "0.1"]
    assert last[1:] == ["constant_velocity", "0", "1", "success", "", *own, ""]
    summary = sweep.read_summary(folder)
    assert (summary["counts"], summary["flights"]) == ({"success": 4}, 4)
    assert (summary["axes"], summary["seeds"]) == (plan.axes, [1])
    assert "link.profile=paper-p3" in summary["overrides"]


def test_a_folder_holds_one_sweep_that_may_grow(write_sweep, folder):
    fly(write_sweep(), folder)
    assert (folder / "table.csv").is_file()
    more = read_plan(write_sweep(seeds=2))
    assert len(sweep.begin(folder, more).kept) == 4
    assert not (folder / "table.csv").exists()  # it has fewer flights than sweep.json says
    for other in (write_sweep({"link.both.delay_ms": [7]}), write_sweep({}, seeds=2)):
        with pytest.raises(BadInputError, match=r"has another sweep, see sweep\.yaml.*new folder"):
            fly(other, folder)


def test_flights_without_a_network_are_rows_that_only_give_the_relative_cost(write_sweep, folder):
    """A sweep without them grows by them; a baseline that failed gives no number."""
    plan = fly(write_sweep(), folder)
    plan = read_plan(write_sweep(cost=True))
    rows = sweep.begin(folder, plan)
    bare = [each for key, each in plan.flights.items() if key not in plan.baselines]
    assert [each.key for each in sweep.flights_of(plan) if each.key not in rows.kept] == [
        each.key for each in bare
    ]
    for each, result in zip(bare, (flown(control_cost=0.5), flown("failure")), strict=True):
        rows.add(each.row(result))
    for key in plan.baselines:
        rows.kept[key]["numbers"]["control_cost"] = 2.0
    (folder / "rows.jsonl").write_text("".join(f"{json.dumps(r)}\n" for r in rows.kept.values()))
    sweep.finish(folder, plan)
    table = [*csv.DictReader((folder / "table.csv").read_text().splitlines())]
    assert [row["J/J0 [1]"] for row in table] == ["4.0", "4.0", "", ""]
    found = sweep.read_sweep(folder)
    assert (len(found.rows), found.flights, found.units["J/J0"]) == (4, 4, "1")


@pytest.mark.parametrize("changed", PLUG_IN)
@pytest.mark.parametrize("shard", [None, (2, 2)])
def test_a_file_that_changed_since_its_flights_is_named(
    write_sweep, folder, tmp_path, changed, shard
):
    for name, text in PLUG_IN.items():
        (tmp_path / name).write_text(text)
    path = write_sweep({"cloud.predictor": ["./mine.py", "last_sample"]})
    fly(path, folder, slice(1), shard=shard and (1, 2))
    with (tmp_path / changed).open("a") as file:
        file.write("# changed\n")
    with pytest.raises(BadInputError, match=rf"changed since its flights: {tmp_path / changed};"):
        fly(path, folder, shard=shard)


def test_other_code_flies_nothing_into_the_folder(write_sweep, folder, monkeypatch):
    """Both hashes are named, so that the user finds the code of the flights."""
    path = write_sweep()
    fly(path, folder, slice(1), (1, 2))
    said = f"its flights are of code {source.code_hash()}, this is code 0123456789abcdef"
    monkeypatch.setattr("cloudrc.base.source.code_hash", lambda: "0123456789abcdef")
    with pytest.raises(BadInputError, match=said):
        fly(path, folder, shard=(2, 2))


def test_rows_of_another_grid_and_other_folders_are_refused(write_sweep, folder):
    with pytest.raises(BadInputError, match="is not a folder of"):
        sweep.read_sweep(folder)
    fly(write_sweep(), folder)
    path = folder / "rows.jsonl"
    path.write_text(path.read_text().replace('"link.both.delay_ms": 40', '"other": 1'))
    with pytest.raises(BadInputError, match="has rows of another grid"):
        sweep.read_sweep(folder)
