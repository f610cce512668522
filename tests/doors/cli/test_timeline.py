# SPDX-License-Identifier: Apache-2.0

"""`cloudrc timeline`: the budget of a run, and a file for Perfetto."""

import json

import pytest

from cloudrc.doors.cli.main import main
from tests.doors.cli.conftest import FLY, SHORT


@pytest.mark.usefixtures("no_page")
def test_the_timeline_of_a_run_is_written_and_its_budget_printed(folder, call):
    main([*FLY, "--out", "a"])
    out = call("timeline a").out
    assert "age when it begins to act" in out
    assert out.endswith("a/timeline.json\n")
    assert json.loads((folder / "a/timeline.json").read_bytes())["traceEvents"]
    found = json.loads(call("timeline a/mission.mcap --out b.json --to 1 -o json").out)
    report = json.loads((folder / "a/report.json").read_bytes())
    budget = found["budgets"]["loop"]
    assert budget == report["budget"]
    measured = report["numbers"]["age_at_actuator_mean"]["value"]
    assert budget["time_average"] == pytest.approx(measured, abs=1e-9)
    sizes = [(folder / name).stat().st_size for name in ("b.json", "a/timeline.json")]
    assert sizes[0] < sizes[1]
    assert "b.json: already there" in call("timeline a --out b.json", code=2).err
    assert "no such file" in call("timeline c", code=2).err


@pytest.mark.usefixtures("no_page", "one_core")
def test_two_budgets_are_compared_stage_by_stage(folder, call, as_json):
    main([*FLY, "--out", "a"])
    main([*FLY, "--out", "b", "--set", "link.downlink.delay_ms=100"])
    rows = [line.split() for line in call("compare a b --budget").out.splitlines()]
    (change,) = [float(row[3]) for row in rows if row[:1] == ["downlink"]]
    assert change > 5
    assert "c: no such file" in call("compare a c --budget", code=2).err
    sides = "link.downlink.delay_ms=10", "link.downlink.delay_ms=40,cloud.compute_ms=4"
    numbers = as_json(f"compare {' '.join(sides)} --budget --seeds 1", *SHORT)["numbers"]
    assert numbers["budget_downlink"]["difference"] > 0.01
    assert list(numbers)[-1] == "age_at_actuator_mean"


@pytest.mark.usefixtures("no_page")
def test_each_robot_of_a_fleet_has_a_budget_with_its_wait_in_the_cell(folder, call):
    cell = "--set fleet.robots=2 --set cell.rate_kbit=1000 --report none --out a"
    main([*FLY, *cell.split()])
    found = json.loads(call("timeline a -o json").out)
    assert list(found["budgets"]) == ["robot-0", "robot-1"]
    for budget in found["budgets"].values():
        total = sum(stage["mean"] for stage in budget["stages"].values())
        assert total == pytest.approx(budget["age"]["mean"], abs=1e-9)
        assert budget["stages"]["uplink_cell"]["mean"] > 0.001
    assert [each["least"] > 0 for each in found["cell"].values()] == [True, True]
    events = json.loads((folder / "a/timeline.json").read_bytes())["traceEvents"]
    assert {each["pid"] for each in events} == {1, 2}
    assert "telemetry passes the cell, all robots" in call("timeline a").out
