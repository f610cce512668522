# SPDX-License-Identifier: Apache-2.0

"""`cloudrc run` with a fleet: a folder for each robot, and one report of all."""

import csv
import json

import pytest

from cloudrc.results.record.columns import Recording
from tests.doors.cli.conftest import FLY, SHORT

FLEET = "--set fleet.robots=3 --set cell.rate_kbit=1000 --set cell.queue=newest".split()
TWO = ["--set", "fleet.robots=2"]


@pytest.mark.usefixtures("no_page")
def test_a_fleet_is_told_as_tables_and_leaves_a_folder_for_each_robot(folder, call, refused):
    lines = call("run", "steps", *SHORT, *FLEET, "--out", "fleet").out.splitlines()
    cell = "3 robots in a cell of 1000 kbit/s (newest)"
    assert lines[0] == f"steps: mode virtual, seed 1, link paper-p3, {cell}, 1 step"
    assert "SUCCESS: all 3 robots succeeded" in lines
    heads = [line.split()[0] for line in lines if line]
    assert heads[2:10] == ["robot", "median", "worst", "0", "1", "2", "cell", "uplink"]
    assert lines[-1] == "fleet/report.html"
    page = (folder / lines[-1]).read_text()
    assert page.count("<tr>") == 9
    assert page.count('class="verdict"') == 4, "of the fleet and of each robot"
    report = json.loads((folder / "fleet/report.json").read_text())
    assert report["succeeded"] == 3
    rows = [*csv.DictReader((folder / "fleet/cell.csv").read_text().splitlines())]
    packets = sum(int(row["packets"]) for row in rows if row["direction"] == "uplink")
    assert packets == report["cell"][0]["packets"]
    for number, robot in enumerate(report["robots"]):
        own = folder / f"fleet/robot-{number}"
        assert Recording.read(own / "mission.mcap").sha256 == robot["records_sha256"]
        assert json.loads((own / "report.json").read_text())["verdict"] == robot["verdict"]
    call("report", "fleet/robot-2")
    assert (folder / "fleet/robot-2/report.html").exists()
    (folder / "fleet/report.html").unlink()
    again = call("report", "fleet").out.splitlines()
    assert again[-1] == "fleet/report.html"
    assert again[1:] == lines[2:]
    assert (folder / "fleet/report.html").exists()
    assert json.loads((folder / "fleet/report.json").read_text()) == report
    assert "fleet: is a fleet; name one of its robots: robot-0, " in refused("replay fleet")


@pytest.mark.usefixtures("no_page")
def test_a_fleet_that_flies_again_tells_which_own_files_have_changed(folder, call):
    file, line = folder / "mine.py", [*FLY, *TWO, "--report", "none", "--out"]
    file.write_text("from cloudrc.cloud.predictors.last_sample import build\n")
    call(*line, "a", "--set", "cloud.predictor=./mine.py")
    file.write_text(f"# new\n{file.read_text()}")
    (folder / "robots.csv").write_text("link.both.delay_ms\n" + "20\n" * 9)
    words = "run a/config.yaml --mode virtual --report none --out b --set fleet.vary=robots.csv"
    again = call(words)
    assert "changed since the flight of a: cloud.predictor" in again.err
    assert "fleet.vary has 9 entries for " in again.err


def test_a_robot_flies_alone_as_in_a_fleet_without_a_cell(folder, call):
    found = []
    for key in ("cloud.cores=2", "fleet.only=1"):
        sets = f"--set={key}", "--set=cloud.compute_ms=1", "--report=none", f"--out={key}"
        call(*FLY, *TWO, *sets)
        found.append(json.loads((folder / key / "report.json").read_text()))
    fleet, alone = found
    assert fleet["robots"][1]["records_sha256"] == alone["records_sha256"]
    assert fleet["cloud"]["rate_expected_hz"] == 100
    assert not (folder / "cloud.cores=2/cell.csv").exists()


@pytest.mark.parametrize(
    "line",
    [
        "run --mode local --set fleet.robots=999",
        "run --mode cluster --set fleet.robots=2",
        "up --set fleet.robots=2",
        "run --seeds 2 --set cell.rate_kbit=100",
        "run --figures --set fleet.robots=2",
        "run --set cloud.controller=remote --set cell.rate_kbit=100",
    ],
)
def test_a_fleet_flies_by_run_alone_and_in_real_time_if_the_machine_carries_it(line, refused):
    assert "fleet" in refused(line)


def test_an_interrupted_fleet_has_a_report(folder, call, monkeypatch):
    def interrupt(run):
        raise KeyboardInterrupt

    monkeypatch.setattr("cloudrc.flight.virtual.fleet.FleetRun.fly", interrupt)
    line = [*FLY, *FLEET, "--report", "none", "--out", "fleet"]
    assert "INTERRUPTED: 3 of 3 robots did not succeed" in call(*line, code=130).out
    assert json.loads((folder / "fleet/report.json").read_text())["cell"] == []
