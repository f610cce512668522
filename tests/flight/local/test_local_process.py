# SPDX-License-Identifier: Apache-2.0

"""Local mode with real processes that are interrupted, killed or stopped; its operator and link."""

import json
import os
import re
import signal
import subprocess
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from cloudrc.flight.local import supervisor
from cloudrc.results import under_way
from cloudrc.results.record.columns import Recording
from cloudrc.wire.messages import GuardState
from tests.conftest import nightly, nightly_rows, wait_until
from tests.flight.conftest import COMMAND, start, wait_until_flying

pytestmark = pytest.mark.process


def report(folder):
    return json.loads((folder / "report.json").read_text())


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def wait_until_ended(pids, limit):
    """Wait until all processes have ended, at most `limit` [s]."""
    wait_until(lambda: not any(map(alive, pids.values())), limit)


@pytest.mark.alone
@pytest.mark.parametrize("how", [signal.SIGINT, *nightly(signal.SIGTERM, signal.SIGHUP)])
def test_ctrl_c_ends_all_processes_in_2_s_and_leaves_a_report(tmp_path, how):
    run = start(tmp_path / "run", report="page")
    pids = wait_until_flying(run)
    assert set(pids) == {"world", "teleop", "cloud", "uplink", "downlink"}
    words = Path(f"/proc/{pids['world']}/cmdline").read_text().split("\0")
    (key,) = (Path(word.removeprefix("--key=")) for word in words if word.startswith("--key="))
    assert key.exists()
    os.kill(run.pid, how)
    wait_until_ended(pids, 2.0)
    run.communicate(timeout=60)
    assert run.returncode == 130
    assert report(tmp_path / "run")["verdict"] == "interrupted"
    assert not key.exists()
    assert not (tmp_path / "run" / "api.json").exists()
    assert (tmp_path / "run" / "report.html").exists()
    assert (tmp_path / "run" / "mission.mcap").stat().st_size > 1000


HANGS, DIES = signal.SIGSTOP, signal.SIGKILL


@pytest.mark.parametrize(
    ("victim", "how"),
    [
        ("uplink", HANGS),
        *nightly_rows(("cloud", DIES), ("cloud", HANGS), ("downlink", HANGS)),
        *nightly_rows(("teleop", HANGS), ("world", HANGS)),
    ],
)
def test_a_supervisor_that_was_paused_sees_who_hangs_or_dies(tmp_path, victim, how):
    run = start(tmp_path / "run", dwell=30.0)
    pids = wait_until_flying(run)
    os.kill(run.pid, signal.SIGSTOP)
    time.sleep(supervisor.SILENCE_LIMIT + 1.0)
    os.kill(run.pid, signal.SIGCONT)
    time.sleep(1.0)
    assert all(alive(pid) for pid in pids.values()), "the flight goes on"
    os.kill(pids[victim], how)
    wait_until_ended(pids, 10.0)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == (4 if how == HANGS else 6)
    assert f"the {victim} process {'was silent' if how == HANGS else 'died'}" in errors
    assert "Traceback" not in errors
    notes = " ".join(report(tmp_path / "run")["notes"])
    stood = re.findall(r"supervisor of this run stood still for ([\d.]+) s", notes)
    assert max(map(float, stood)) >= supervisor.SILENCE_LIMIT + 1.0


def call(folder, *words):
    return subprocess.run([*COMMAND, *words, "--run", str(folder)], capture_output=True, text=True)


CAUSE = "downlink.delay_ms=120, downlink.jitter_ms=0"


@pytest.mark.alone
def test_an_operator_sets_the_link_of_a_run_and_cancels_it(tmp_path):
    folder, took = tmp_path / "run", []
    run = start(folder, dwell=30.0, report="page")
    wait_until_flying(run)
    assert json.loads((folder / "api.json").read_text())["url"] == under_way.under_way()[folder]
    time.sleep(1.0)
    for words in (CAUSE.split(", "), ["--profile", "handover"]):
        made = call(folder, "link", "set", *words, "-o", "json")
        took.append(json.loads(made.stdout)["seconds"])
        time.sleep(1.0)
    assert "INTERRUPTED" in call(folder, "mission", "cancel").stdout
    output, _ = run.communicate(timeout=60)
    assert run.returncode == 130
    assert report(folder)["failures"][0]["code"] == "cancelled"
    assert under_way.under_way() == {}
    assert f"link: downlink 120 ms ({CAUSE})" in output
    assert not (folder / "link").exists()
    assert min(took) <= 1.0
    assert max(took) < 2.0, "on a busy machine"
    check_delays(Recording.read(folder / "mission.mcap"))
    page = (folder / "report.html").read_text()
    assert "Vertical lines: the link was set in flight (downlink.delay_ms=120" in page


def check_delays(recording):
    """Check that the median delays of the downlink follow its changes."""
    link, delays = recording["/link"], recording["/downlink_delay"]["delay"]
    ages = zip(link["cause"], link["stamp_ns"] - link["age"] * 1e9, link["uplink"], strict=True)
    told = {cause: stamp for cause, stamp, uplink in ages if not uplink}
    sent_ns = recording["/downlink_delay"]["stamp_ns"] - delays * 1e9
    edges = [0.0, told[CAUSE], told["profile handover"], told["profile handover"] + 8.9e9]
    parts = [delays[(sent_ns > a + 1e8) & (sent_ns < b)] for a, b in pairwise(edges)]
    asked = [0.045, 0.120, 0.025]
    assert list(map(np.median, parts)) == pytest.approx(asked, abs=0.005), "beside other tests"


FAULTS = """faults=[
{kind: cloud_killed, at_s: 4, duration_s: 0.5},
{kind: partition, at_s: 7, duration_s: 0.5},
{kind: teleop_killed, at_s: 9, duration_s: 0.5},
{kind: world_paused, at_s: 12, duration_s: 0.6},
{kind: cloud_paused, at_s: 14, duration_s: 0.6}]"""


@pytest.mark.alone
def test_faults_are_real_signals_and_the_mission_goes_on(tmp_path):
    run = start(tmp_path / "run", FAULTS, dwell=18.0)
    output, errors = run.communicate(timeout=90)
    assert run.returncode == 0, output + errors
    recording = Recording.read(tmp_path / "run" / "mission.mcap")
    assert recording["/mission"]["event"].tolist() == ["started", "resumed", "reached", "done"]
    assert (recording["/session"]["end"] == "world").sum() == 3, "of cloud, mission, new cloud"
    sent, guard, link = (recording[topic] for topic in ("/telemetry", "/guard", "/link"))
    up_ns = link["stamp_ns"][0] - link["time_line"][0] * 1e9
    held = (guard["stamp_ns"][guard["state"] == GuardState.HOLD] - up_ns) * 1e-9
    assert held[:2].tolist() == pytest.approx([4.25, 7.25], abs=0.3), "all faults count alike"
    assert sent["slip_ns"][-1] * 1e-9 == pytest.approx(0.6, abs=0.15)
    (hole,) = recording.holes
    assert (hole.end_ns - hole.begin_ns) * 1e-9 < 5.0, "the new cloud records"
