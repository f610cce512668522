"""Local mode with real processes: what becomes of a run that is not left in peace."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytestmark = pytest.mark.process

HOVER = ["hover", "--mode", "local", "--set", "mission.waypoints.0.dwell_s={dwell}"]


def start(folder: Path, *settings: str, dwell: float = 20.0) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "cloudrc", "run", *HOVER, "--out", str(folder)]
    command[-3] = command[-3].format(dwell=dwell)
    for setting in settings:
        command += ["--set", setting]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


def children(parent: int) -> dict[str, int]:
    """Process ids by what they are: relay, world, cloud."""
    found = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            stat, line = path.read_text(), (path.parent / "cmdline").read_text().split("\0")
        except OSError:
            continue
        if int(stat.rpartition(")")[2].split()[1]) == parent and "cloudrc" in line:
            found[line[line.index("cloudrc") + 1]] = int(path.parent.name)
    return found


def wait_until_flying(run: subprocess.Popen[str]) -> dict[str, int]:
    assert run.stdout is not None
    for line in run.stdout:
        if "mission started" in line:
            return children(run.pid)
    raise AssertionError(run.stderr.read() if run.stderr else "")


def report(folder: Path) -> dict:
    return json.loads((folder / "report.json").read_text())


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_ends_all_processes_within_two_seconds_and_leaves_a_report(tmp_path, how):
    run = start(tmp_path / "run")
    pids = wait_until_flying(run)
    assert set(pids) == {"relay", "world", "cloud"}
    os.kill(run.pid, how)
    asked = time.monotonic()
    while any(alive(pid) for pid in pids.values()):
        assert time.monotonic() - asked < 2.0
        time.sleep(0.02)
    run.communicate(timeout=60)
    assert run.returncode == 130
    assert report(tmp_path / "run")["verdict"] == "interrupted"
    assert (tmp_path / "run" / "report.html").exists()
    assert (tmp_path / "run" / "mission.mcap").stat().st_size > 1000


@pytest.mark.parametrize("victim", ["world", "cloud", "relay"])
def test_a_process_that_dies_ends_the_run_and_is_named(tmp_path, victim):
    run = start(tmp_path / "run")
    pids = wait_until_flying(run)
    os.kill(pids[victim], signal.SIGKILL)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 6
    assert f"the {victim} process died" in errors
    assert "Traceback" not in errors
    assert not any(alive(pid) for pid in pids.values())
    assert report(tmp_path / "run")["verdict"] in ("interrupted", "invalid")


def test_the_processes_end_when_the_one_that_started_them_is_killed(tmp_path):
    run = start(tmp_path / "run")
    pids = wait_until_flying(run)
    run.kill()
    run.communicate()
    until = time.monotonic() + 3.0
    while any(alive(pid) for pid in pids.values()):
        assert time.monotonic() < until
        time.sleep(0.05)


SLOW = '''
"""A predictor that takes 50 ms."""
import time
from cloudrc.cloud.predictors import Predictor
class Slow(Predictor):
    def predict(self, odometry, horizon):
        time.sleep(0.05)
        return odometry
def build() -> Predictor:
    """Make it."""
    return Slow()
'''


def test_a_slow_predictor_is_counted_and_the_flight_goes_on(tmp_path):
    (tmp_path / "slow.py").write_text(SLOW)
    run = start(tmp_path / "run", f"cloud.predictor={tmp_path}/slow.py", dwell=2.0)
    _, errors = run.communicate(timeout=90)
    numbers = report(tmp_path / "run")["numbers"]
    assert run.returncode == 0, errors
    assert numbers["cloud_lateness_p99"]["value"] > 0.02


@pytest.mark.full
@pytest.mark.parametrize("attempt", range(3))
def test_real_time_takes_as_long_as_virtual_time(tmp_path, attempt):
    reports = {}
    for mode in ("virtual", "local"):
        folder = tmp_path / mode
        command = [sys.executable, "-m", "cloudrc", "run", "paper", "--mode", mode]
        subprocess.run([*command, "--out", str(folder)], check=True, capture_output=True)
        reports[mode] = report(folder)["numbers"]
    local, virtual = reports["local"], reports["virtual"]
    contact = "contact_time"
    assert local[contact]["value"] == pytest.approx(virtual[contact]["value"], rel=0.05)
    for name in ("real_time_factor", "world_lateness_p99", "cloud_lateness_p99"):
        assert local[name]["value"] > 0
