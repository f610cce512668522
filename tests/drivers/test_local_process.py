"""Local mode with real processes that are interrupted, killed or stopped."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from cloudrc.drivers import local as flights
from tests.conftest import nightly

pytestmark = pytest.mark.process

ENDS = ("world", "cloud")
FLOWN = (0, 6)
"""Exit codes of a finished run, in real time or not: the machine may be busy."""
HOVER = ["hover", "--mode", "local", "--set", "mission.waypoints.0.dwell_s={dwell}"]


def start(folder: Path, *settings: str, dwell: float = 20.0) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "cloudrc", "run", *HOVER, "--out", str(folder)]
    command[-3] = command[-3].format(dwell=dwell)
    for setting in settings:
        command += ["--set", setting]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


def children(parent: int) -> dict[str, int]:
    """Return the process ids by role: relay, world, teleop, cloud."""
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


@pytest.mark.parametrize("how", [signal.SIGINT, *nightly(signal.SIGTERM, signal.SIGHUP)])
def test_ctrl_c_ends_all_processes_in_2_s_and_leaves_a_report(tmp_path, how):
    run = start(tmp_path / "run")
    pids = wait_until_flying(run)
    assert set(pids) == {"relay", "world", "teleop", "cloud"}
    words = Path(f"/proc/{pids['world']}/cmdline").read_text().split("\0")
    (key,) = (Path(word.removeprefix("--key=")) for word in words if word.startswith("--key="))
    assert key.exists()
    os.kill(run.pid, how)
    asked = time.monotonic()
    while any(alive(pid) for pid in pids.values()):
        assert time.monotonic() - asked < 2.0
        time.sleep(0.02)
    run.communicate(timeout=60)
    assert run.returncode == 130
    assert report(tmp_path / "run")["verdict"] == "interrupted"
    assert not key.exists()
    assert not (tmp_path / "run" / "api.json").exists()
    assert (tmp_path / "run" / "report.html").exists()
    assert (tmp_path / "run" / "mission.mcap").stat().st_size > 1000


@pytest.mark.parametrize("victim", ["cloud", *nightly("world", "teleop", "relay")])
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


def test_the_processes_end_when_their_supervisor_is_killed(tmp_path):
    run = start(tmp_path / "run")
    pids = wait_until_flying(run)
    run.kill()
    run.communicate()
    until = time.monotonic() + 3.0
    while any(alive(pid) for pid in pids.values()):
        assert time.monotonic() < until
        time.sleep(0.05)


def operate(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    verb, *rest = words
    command = [sys.executable, "-m", "cloudrc", "mission", verb, "--run", str(folder), *rest]
    return subprocess.run(command, capture_output=True, text=True)


def test_the_operator_stops_moves_and_cancels_a_run_that_flies(tmp_path):
    folder = tmp_path / "run"
    run = start(folder)
    wait_until_flying(run)
    assert json.loads((folder / "api.json").read_text())["url"] == flights.under_way()[folder]
    assert operate(folder, "run", "hover").returncode == 5  # a mission already flies
    assert "held" in operate(folder, "hold").stdout
    assert operate(folder, "goto", "0", "0", "99").returncode == 2
    assert operate(folder, "goto", "0.3", "0", "0.8").returncode == 0
    time.sleep(3.0)
    status = json.loads(operate(folder, "status", "-o", "json").stdout)
    assert status["mission"]["state"] == "held"
    assert status["seen"]["position_m"] == pytest.approx([0.3, 0.0, 0.8], abs=0.1)
    assert "flying" in operate(folder, "resume").stdout
    anywhere = [sys.executable, "-m", "cloudrc", "mission", "status", "-o", "json"]
    found = subprocess.run(anywhere, capture_output=True, text=True, cwd="/")
    assert found.stderr == f"cloudrc: using the run in {folder}\n"
    assert json.loads(found.stdout)["mission"]["state"] == "flying"
    assert "INTERRUPTED" in operate(folder, "cancel").stdout
    run.communicate(timeout=60)
    assert run.returncode == 130
    assert report(folder)["failures"][0]["code"] == "cancelled"
    audit = [json.loads(line) for line in (folder / "audit.jsonl").read_text().splitlines()]
    said = [(line["action"].rpartition("/")[2], line["status"], line["client"]) for line in audit]
    done = [("missions", 409), ("hold", 200), ("goto", 422), ("goto", 200), ("resume", 200)]
    assert said[:5] == [(action, status, "local") for action, status in done]
    assert said[5][0] == "cancel"
    assert flights.under_way() == {}


def test_without_fastapi_it_flies_without_an_api_and_says_so(tmp_path):
    program = (
        "import sys; from cloudrc.cli import extras; "
        "extras.EXTRAS['api'] = ('fastapi_is_not_here',); "
        "from cloudrc.cli.main import main; sys.exit(main(sys.argv[1:]))"
    )
    words = ["run", *HOVER, "--out", str(tmp_path / "run")]
    words[-3] = words[-3].format(dwell=0.1)
    command = [sys.executable, "-c", program, *words]
    run = subprocess.run(command, capture_output=True, text=True, timeout=90)
    assert run.returncode == 0
    assert "no operator's API in this run" in run.stderr
    assert "pip install 'cloudrc[api]'" in run.stderr


PREDICTOR = '''
"""A predictor that {does}."""
import time
from cloudrc.cloud.predictors import Predictor
class Odd(Predictor):
    def predict(self, odometry, horizon):
        {statement}
        return odometry
def build() -> Predictor:
    """Make it."""
    return Odd()
'''


def predictor(folder: Path, does: str, statement: str) -> str:
    """Write such a plug-in; return the setting that selects it."""
    (folder / "odd.py").write_text(PREDICTOR.format(does=does, statement=statement))
    return f"cloud.predictor={folder}/odd.py"


def test_a_slow_predictor_is_reported_and_the_flight_continues(tmp_path):
    run = start(tmp_path / "run", predictor(tmp_path, "is slow", "time.sleep(0.05)"), dwell=2.0)
    output, errors = run.communicate(timeout=90)
    document = report(tmp_path / "run")
    assert run.returncode in FLOWN, errors
    assert document["numbers"]["cloud_lateness_p99"]["value"] > 0.02
    assert document["numbers"]["missed_periods"]["value"] > 100
    assert "a plug-in is slow" in output
    assert any("a plug-in is slow" in note for note in document["notes"])


def test_what_a_plug_in_prints_goes_to_the_log(tmp_path):
    run = start(tmp_path / "run", predictor(tmp_path, "talks", "print('hello')"), dwell=0.5)
    _, errors = run.communicate(timeout=60)
    assert run.returncode in FLOWN, errors
    assert "hello" in (tmp_path / "run" / "cloud.log").read_text()


@pytest.mark.parametrize("victim", ["relay", *nightly("teleop", "world", "cloud")])
def test_a_process_that_hangs_ends_the_run_and_is_named(tmp_path, victim):
    run = start(tmp_path / "run")
    pids = wait_until_flying(run)
    os.kill(pids[victim], signal.SIGSTOP)
    stopped = time.monotonic()
    while any(alive(pid) for pid in pids.values()):
        assert time.monotonic() - stopped < 10.0
        time.sleep(0.05)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 4
    assert f"the {victim} process was silent" in errors


def test_a_link_that_comes_up_late_ends_no_run(tmp_path):
    """Without a session world has no telemetry to tell of, but it is alive."""
    late = f"blackouts=[{{start_s: 0, duration_s: {flights.SILENCE_LIMIT + 1.0}}}]"
    run = start(tmp_path / "run", f"link.uplink.{late}", f"link.downlink.{late}")
    wait_until_flying(run)
    os.kill(run.pid, signal.SIGINT)
    run.communicate(timeout=60)
    assert run.returncode == 130


def test_a_supervisor_that_stood_still_takes_the_flight_up_again(tmp_path):
    run = start(tmp_path / "run", dwell=8.0)
    wait_until_flying(run)
    os.kill(run.pid, signal.SIGSTOP)
    time.sleep(flights.SILENCE_LIMIT + 1.0)
    os.kill(run.pid, signal.SIGCONT)
    _, errors = run.communicate(timeout=60)
    assert run.returncode in FLOWN, errors
    (note,) = (note for note in report(tmp_path / "run")["notes"] if "supervisor" in note)
    assert "stood still for 6." in note


def test_a_run_whose_supervisor_was_killed_gets_a_report(tmp_path):
    folder = tmp_path / "run"
    run = start(folder)
    pids = wait_until_flying(run)
    time.sleep(1.0)
    run.kill()
    run.communicate()
    until = time.monotonic() + 3.0
    while any(alive(pid) for pid in pids.values()) and time.monotonic() < until:
        time.sleep(0.05)
    assert not (folder / "mission.mcap").exists()
    command = [sys.executable, "-m", "cloudrc", "report", str(folder)]
    subprocess.run(command, check=False, capture_output=True)
    assert report(folder)["numbers"]["commands_applied"]["value"] > 10
    assert (folder / "mission.mcap").exists()
    assert (folder / "report.html").exists()


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


def private_memory(pid: int) -> int:
    """Return the private memory of a process [bytes]."""
    status = Path(f"/proc/{pid}/status").read_text()
    return 1024 * int(status.partition("RssAnon:")[2].split()[0])


@pytest.mark.full
def test_an_hour_of_recording_takes_below_a_megabyte(tmp_path, figure):
    """Measured over half an hour, once a quarter of an hour has filled all buffers."""
    run = start(tmp_path / "run", "criteria.time_limit_s=3600", dwell=3000.0)
    pids = {name: pid for name, pid in wait_until_flying(run).items() if name in ENDS}
    memory = []
    for minutes in (15, 30):
        with suppress(subprocess.TimeoutExpired):  # reads what the run prints meanwhile
            run.communicate(timeout=60.0 * minutes)
        memory.append({name: private_memory(pid) for name, pid in pids.items()})
    run.terminate()
    run.communicate(timeout=60)
    for name in ENDS:
        grown = (memory[1][name] - memory[0][name]) * 2
        figure(f"{name} with a recording: memory grown in an hour", grown * 1e-6, "<=", 1.0, "MB")
