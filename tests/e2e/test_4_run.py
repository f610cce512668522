"""`cloudrc run --mode cluster` leaves what a run leaves, and flies as in virtual time."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from cloudrc.config.load import load_experiment
from tests.e2e.conftest import NAME, NAMESPACE, cloudrc
from tests.flights.conftest import fly, numbers

CONTACT_TOLERANCE = 0.05
"""Of the contact time, against the virtual run, as a share of it."""
DELAY, DELAY_TOLERANCE = 0.045, 0.002
"""Of the paper's second profile, each way [s]."""


@pytest.fixture(scope="module")
def report(installed: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run") / "paper"
    place = ["-n", NAMESPACE, "--release", NAME]
    done = cloudrc("run", "paper", "--mode", "cluster", *place, "--out", str(folder))
    assert done.returncode == 0, done.stdout + done.stderr
    assert done.stdout.splitlines()[-1] == str(folder / "report.html")
    return folder


def test_the_doctor_finds_what_a_run_needs(installed: None) -> None:
    done = cloudrc("doctor", "--mode", "cluster", "-o", "json")
    assert done.returncode == 0, done.stdout + done.stderr
    found = {check["name"]: check["state"] for check in json.loads(done.stdout)["checks"]}
    assert (found["kubeconfig"], found["cluster"]) == ("ok", "ok")


def test_everything_that_a_run_leaves_is_there(report: Path) -> None:
    wanted = ["report.html", "report.json", "mission.mcap", "config.yaml", "environment.json"]
    wanted += [f"figures/{name}.png" for name in ("delay", "odom", "error")]
    assert [name for name in wanted if not (report / name).is_file()] == []
    document = json.loads((report / "report.json").read_text())
    assert (document["verdict"], document["mode"]) == ("success", "cluster")
    assert (document["shaper"], document["complete"]) == ("relay", True)


def test_the_flight_is_that_of_virtual_time(report: Path, note: Callable[[str], None]) -> None:
    document = json.loads((report / "report.json").read_text())
    found = {name: entry["value"] for name, entry in document["numbers"].items()}
    wanted = numbers(fly("paper"))
    note(
        f"contact at {found['contact_time']:.2f} s, in virtual time {wanted['contact_time']:.2f} s"
    )
    assert found["contact_time"] == pytest.approx(wanted["contact_time"], rel=CONTACT_TOLERANCE)
    for direction in ("uplink", "downlink"):
        assert found[f"{direction}_delay_mean"] == pytest.approx(DELAY, abs=DELAY_TOLERANCE)
    assert found["pipe_contacts"] == 0
    assert load_experiment(report / "config.yaml").name == "paper"
