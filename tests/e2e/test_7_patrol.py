"""kubectl alone flies a mission of a release, whose report outlives the pods."""

import json

import pytest

from cloudrc.cluster.client import connect
from cloudrc.cluster.flight import wait_ready
from tests.e2e.conftest import CHART, NAME, NAMESPACE, cloudrc, fly, helm, job_end, kubectl

PATROL = "cloudrc-patrol"


@pytest.fixture(scope="module")
def patrol(installed):
    """A Job that kubectl makes of the suspended CronJob."""
    given = "link.mode=relay,mission.cronJob.enabled=true,mission.plan=hover,recordings.storage=1Gi"
    release = connect(None, NAMESPACE, PATROL)
    helm("install", PATROL, str(CHART), f"--set={given},fullnameOverride=patrol")
    try:
        wait_ready(release, timeout=120.0)
        kubectl("create", "job", "by-hand", "--from=cronjob/patrol-mission")
        end, log = job_end("by-hand")
        assert end.exit_code == 0, (end, log)
        yield log
    finally:
        helm("uninstall", PATROL, "--wait")
        kubectl("delete", "pvc", "patrol-recordings", "--wait=false")


def report(folder, *words):
    line = ["mission", "report", *words, "-n", NAMESPACE, "--out", str(folder), "-o", "json"]
    done = cloudrc(*line)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (folder / "report.html").is_file()
    return json.loads(done.stdout)


@pytest.mark.real_time
def test_the_report_of_a_patrol_is_kept_when_its_pods_are_gone(patrol, tmp_path):
    (name,) = (line.split()[-1] for line in patrol.splitlines() if line.startswith("report: "))
    kubectl("delete", "pods", f"--selector=app.kubernetes.io/instance={PATROL}")
    wait_ready(connect(None, NAMESPACE, PATROL), timeout=120.0)
    found = report(tmp_path / "kept", PATROL, name)
    assert (found["verdict"], found["complete"]) == ("success", True)


@pytest.mark.real_time
def test_the_last_mission_of_a_release_without_a_volume_has_a_report(installed, tmp_path):
    fly("reported", [{"position_m": [0.5, 0.0, 0.7], "dwell_s": 1.0}])
    job_end("reported")
    found = report(tmp_path / "last", NAME)
    assert (found["verdict"], found["complete"]) == ("success", True)
