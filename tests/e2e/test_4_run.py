# SPDX-License-Identifier: Apache-2.0

"""The images; `cloudrc run --mode cluster` is like a run in virtual time; another robot drives."""

import json

import pytest

from cloudrc import __version__
from cloudrc.config.load import load_experiment
from tests.conftest import nightly_rows
from tests.e2e.conftest import (
    CHART,
    NAMESPACE,
    cloudrc,
    command,
    eventually,
    helm,
    in_release,
    job_end,
    kubectl,
    read,
    report,
    until_ready,
)
from tests.flights.conftest import fly, numbers

TIME_TOLERANCE = 0.05
"""Largest deviation of a time in the flight from that in virtual time, as a share [1]."""
DELAY_TOLERANCE = 0.002
"""Largest deviation of a mean delay from that in virtual time [s]."""
SIZES = {"world": 420, "cloud": 320}
"""Role -> largest size of its image, uncompressed [MB]."""
ROVER = "rover"
"""Release of another robot, whose recordings are in a volume."""
LOOK = """\
import json, os, shutil
from importlib.util import find_spec
found = [*filter(shutil.which, ["cc", "gcc", "g++", "make"])]
found += filter(find_spec, ["mujoco", "matplotlib", "pip"])
found += filter(os.path.exists, ["/root/.cache"])
print(json.dumps(found))
"""
"""Python code that lists the compilers, large packages, pip and cache that an image has."""


@pytest.fixture(scope="module", autouse=True)
def rover(installed):
    """A release of its own; beside the first tests of this module, the Job `by-hand` drives it.

    Later than `installed`, which deletes the Jobs of an earlier session.
    """
    world = "experiment.world.robot=rover,experiment.world.scene=pillars"
    given = (
        f"link.mode=relay,mission.plan=,experiment.mission=pillars,recordings.storage=100Mi,{world}"
    )
    patrol = CHART / "examples" / "values-patrol.yaml"
    try:
        helm("install", ROVER, str(CHART), f"--values={patrol}", f"--set={given}")
        kubectl("create", "job", "by-hand", f"--from=cronjob/{ROVER}-cloudrc-mission")
        yield
    finally:
        helm("uninstall", ROVER)
        kubectl("delete", "pvc", f"{ROVER}-cloudrc-recordings", "--wait=false")


@pytest.mark.parametrize(("role", "holds"), [("world", ["mujoco"]), ("cloud", [])])
def test_an_image_is_small_and_holds_no_more_than_its_role_needs(cluster, note, role, holds):
    image = f"cloudrc/{role}:{__version__}"
    size = int(command("docker", "image", "inspect", "--format={{.Size}}", image)) / 1e6
    note(f"image {role}: asked {SIZES[role]} MB | {size:.0f} MB")
    assert size <= SIZES[role]
    look = ["docker", "run", "--rm", "--user=0", "--entrypoint=python", image, "-c", LOOK]
    assert json.loads(command(*look)) == holds


@pytest.mark.full
def test_an_image_that_is_not_loaded_is_named(cluster):
    helm("install", "no-image", str(CHART), "--set=image.tag=0.0.0-missing")
    line = ["run", "hover", "--mode", "cluster", "-n", NAMESPACE, "--release", "no-image"]
    try:
        done = cloudrc(*line, "--timeout", "60")
    finally:
        helm("uninstall", "no-image")
    (said,) = [each for each in done.stderr.splitlines() if each.startswith("cloudrc: error:")]
    assert done.returncode == 5
    assert ":0.0.0-missing" in said
    assert "make kind-load" in said
    assert "Traceback" not in done.stderr


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("name", "setting", "instant"),
    [
        ("hover", "mission.waypoints.0.dwell_s=6", "duration"),
        *nightly_rows(("paper", "seed=1", "contact_time")),
    ],
)
def test_a_run_in_a_cluster_is_that_of_virtual_time(
    installed, tmp_path, note, name, setting, instant
):
    done = cloudrc("doctor", "--mode", "cluster", "-o", "json")
    found = {check["name"]: check["state"] for check in json.loads(done.stdout)["checks"]}
    assert (done.returncode, found["kubeconfig"], found["cluster"]) == (0, "ok", "ok")
    run = tmp_path / name
    line = ["run", name, "--set", setting, "--mode", "cluster", "--figures"]
    said = in_release(*line, "--out", str(run))
    assert said.splitlines()[-1] == str(run / "report.html")
    wanted = ["report.html", "report.json", "mission.mcap", "config.yaml", "environment.json"]
    wanted += [f"figures/{name}.png" for name in ("delay", "odom", "error")]
    assert [name for name in wanted if not (run / name).is_file()] == []
    document = json.loads((run / "report.json").read_text())
    assert (document["verdict"], document["mode"]) == ("success", "cluster")
    assert (document["shaper"], document["complete"]) == ("relay", True)
    real = {name: entry["value"] for name, entry in document["numbers"].items()}
    virtual = numbers(fly(name, setting))
    note(f"{name}: {instant} {real[instant]:.2f} s, in virtual time {virtual[instant]:.2f} s")
    assert real[instant] == pytest.approx(virtual[instant], rel=TIME_TOLERANCE)
    for mean in ("uplink_delay_mean", "downlink_delay_mean"):
        assert real[mean] == pytest.approx(virtual[mean], abs=DELAY_TOLERANCE)
    assert load_experiment(run / "config.yaml").name == name


@pytest.mark.real_time
def test_kubectl_alone_drives_another_robot():
    end, log = job_end("by-hand", ROVER)
    assert end.exit_code == 0, (end, log)
    assert "waypoint 4 of 4 reached" in log
    assert "report: " in log


@pytest.mark.real_time
def test_mission_run_leaves_a_report_that_stays_when_the_pods_are_gone(tmp_path):
    log = in_release("mission", "run", "pillars", release=ROVER)
    (name,) = (line.split()[-1] for line in log.splitlines() if line.startswith("report: "))
    kubectl("delete", "pods", f"--selector=app.kubernetes.io/instance={ROVER}")
    until_ready(ROVER)
    found = report(tmp_path / "kept", ROVER, name)
    assert (found["verdict"], found["complete"]) == ("success", True)


@pytest.mark.full
def test_a_patrol_flies_by_itself_when_its_schedule_asks():
    def flown():
        jobs = read("jobs")["items"]
        own = [job for job in jobs if job["metadata"]["name"].startswith(f"{ROVER}-cloudrc-miss")]
        return [job for job in own if job["status"].get("succeeded")]

    each_minute = "--set=mission.cronJob.schedule=* * * * *"
    helm("upgrade", ROVER, str(CHART), "--reset-then-reuse-values", each_minute)
    eventually(flown, "a Job of the CronJob has succeeded", 240.0)
