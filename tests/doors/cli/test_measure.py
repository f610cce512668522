# SPDX-License-Identifier: Apache-2.0

"""`cloudrc measure compute`: the file of computing times, which cloud.compute_ms takes."""

import json
from pathlib import Path

import pytest

from cloudrc.config.compute import compute_times
from cloudrc.doors.cli.eval_values import read_compute
from cloudrc.flight import machine
from cloudrc.studies import cpu_limit
from tests.doors.cli.conftest import FLY

TIMES = ["--report", "none", "--set", "link.profile=paper-p1", "--set"]


def times(path):
    comment, head, *lines = path.read_text().splitlines()
    assert (comment[0], head) == ("#", "compute_ms")
    return [*map(float, lines)]


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


@pytest.mark.parametrize("load", [0.5, 99.0])
def test_a_controller_is_measured_without_a_limit_where_none_is_allowed(
    load, folder, call, monkeypatch
):
    monkeypatch.setattr("os.getloadavg", lambda: (load, 0.0, 0.0))
    monkeypatch.setattr(machine, "CGROUP", folder / "none")
    monkeypatch.setattr(cpu_limit.time, "sleep", lambda seconds: None)
    out, err = call("measure compute pid --cpus 0.5 --seconds 1")
    assert out.startswith("pid, 100 Hz: ")
    assert "measured without a CPU limit: this system has no control groups" in err
    assert ("with a load of 99.0" in err) == (load == 99.0)
    assert len(times(folder / "compute.txt")) > 20


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ("compute_ms\n", "has no time above 0"),
        ("compute_ms\n1\nx\n", "t.txt, line 3: "),
        ("compute_s\n1\n-3\n", "t.txt, line 3: "),
        ("4\n5\n", "t.txt, line 1: numbers without a header"),
        ("compute\n4\n", "column compute has no unit"),
    ],
)
def test_a_wrong_file_is_refused(lines, said, folder, refused):
    (folder / "t.txt").write_text(lines)
    assert said in refused("run steps --mode virtual --set cloud.compute_ms=./t.txt")
    assert said in refused("eval --env E --policy ./p.py --compute t.txt")


@pytest.mark.parametrize(
    ("lines", "told"),
    [("compute_ms\n4\n", ""), ("step,latency_s\n7,0.004\n", "latency_s counts; left out: step")],
)
def test_a_file_has_one_unit_at_all_doors(lines, told, folder, caplog):
    Path("t.txt").write_text(lines)
    assert compute_times("./t.txt") == (4.0,)
    assert read_compute("t.txt") == (("file", "t.txt"), (0.004,))
    assert caplog.text.count("left out") == 2 * bool(told)
    assert told in caplog.text
