"""`cloudrc measure compute`: the file of computing times, which cloud.compute_ms takes."""

import json

import pytest

from cloudrc.drivers import cpu_limit, machine
from tests.cli.conftest import FLY

TIMES = ["--report", "none", "--set", "link.profile=paper-p1", "--set"]


def times(path):
    lines = path.read_text().splitlines()
    return [float(line) for line in lines if not line.startswith("#")]


def test_the_times_of_a_measured_flight_are_flown_again(folder, call):
    call(*FLY, *TIMES, "cloud.compute_measured=true", "--out", "a")
    out = call("measure compute a --out t.txt").out.splitlines()
    assert out[-1] == "t.txt: fly it with --set cloud.compute_ms=./t.txt"
    there = folder / "there.txt"
    assert call(f"measure compute a --out {there}").out.endswith(f"cloud.compute_ms={there}\n")
    measured = times(folder / "t.txt")
    assert 0 < min(measured) < max(measured) < 200
    call(*FLY, *TIMES, "cloud.compute_ms=./t.txt", "--out", "b")
    assert json.loads((folder / "b/report.json").read_text())["verdict"] == "success"
    assert "needs a flight in real time" in call("measure compute b --out d.txt", code=2).err


def test_a_controller_is_measured_without_a_limit_where_none_is_allowed(folder, call, monkeypatch):
    monkeypatch.setattr(machine, "CGROUP", folder / "none")
    monkeypatch.setattr(cpu_limit.time, "sleep", lambda seconds: None)
    out, err = call("measure compute pid --cpus 0.5 --seconds 1")
    assert out.startswith("pid, 100 Hz: ")
    assert "measured without a CPU limit: this system has no control groups" in err
    assert len(times(folder / "compute.txt")) > 20


@pytest.mark.parametrize(
    ("line", "said"),
    [("", "has no time above 0"), ("1\nx\n", "t.txt:2: "), ("1\n-3\n", "t.txt:2: ")],
)
def test_a_wrong_file_is_refused(line, said, folder, refused):
    (folder / "t.txt").write_text(line)
    assert said in refused("run steps --mode virtual --set cloud.compute_ms=./t.txt")
