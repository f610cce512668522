# SPDX-License-Identifier: Apache-2.0

"""`cloudrc run --mode cluster` from the flags to the report, on a fake cluster."""

import json
import shutil
from functools import cache
from math import nan
from unittest.mock import Mock

import pytest

from cloudrc.cluster import flight
from cloudrc.cluster.client import connect
from cloudrc.cluster.flight import chart_values, loaded_tag
from cloudrc.cluster.jobs import run_job
from cloudrc.config.load import load_experiment
from cloudrc.config.shipped import FOLDERS
from cloudrc.physics.geometry.scene import SCENES
from cloudrc.results.record.writer import McapWriter
from cloudrc.wire.records import LinkChanged
from tests.cluster.conftest import missions_of, terminated
from tests.flights.conftest import records
from tests.results.record.conftest import later

SECOND = 1_000_000_000
NAME, SETTING = "hover", "mission.waypoints.0.dwell_s=1.0"
LINE = f"run {NAME} --set {SETTING} --mode cluster -o json"


@cache
def flown():
    world, cloud = records(load_experiment(NAME, [SETTING]))
    link = LinkChanged(world[0].stamp_ns, True, "relay", "", 0.0, nan, 0.02, 0.0, 0.0, nan, "{}")
    return [link, *world], cloud


def record(folder, *flights, torn):
    """Record flights as two pods do; `torn` files lack their end, as if copied in flight."""
    for number, name in enumerate(("world", "cloud")):
        path = folder / f"{name}.mcap"
        with McapWriter(path, clock=name, clock_id="same") as writer:
            for each in flights:
                writer.write(each[number])
            writer.flush()
            size = path.stat().st_size
        if torn:
            with path.open("r+b") as file:
                file.truncate(size)


BEFORE = {"metrics": {"allowFrom": ["x"]}, "mission": {"enabled": True, "queue": True}}
"""Values of the release before a run."""


@pytest.fixture
def ready(running, teleop, pretend, tmp_path, monkeypatch):
    """A release whose pods have recorded a flight."""
    monkeypatch.setattr(flight, "FLUSH", 0.0)
    monkeypatch.setattr("cloudrc.results.report.write._draw", lambda *given, **wanted: None)
    monkeypatch.chdir(tmp_path)
    world, _ = flown()
    record(tmp_path, flown(), (later(world[-300:], SECOND), []), torn=True)
    pretend(
        "helm",
        f"echo $@ >> {tmp_path}/helm; case $1 in list) echo '[1]' ;;"
        f" get) echo '{json.dumps(BEFORE)}' ;; *) cat > {tmp_path}/values ;; esac",
    )
    pretend(
        "kubectl",
        f'case "$*" in *ls*world.before*) ls {tmp_path}/left || true ;; *ls*before*) ;;'
        f" *exec*world.before*) cat {tmp_path}/left ;;"
        f" *patch*) echo $* >> {tmp_path}/patched ;;"
        f" *exec*world*) cat {tmp_path}/world.mcap ;;"
        f" *exec*cloud*) cat {tmp_path}/cloud.mcap ;; *) {teleop.forwards()} ;; esac",
    )
    return running


def ends(api, kind="Complete", exit_code=0, message="done"):
    """Let the Job end at the second look."""

    def action():
        (name,) = [key[1] for key in api.objects if key[0] == "jobs"]
        api.start_pod(name, state=terminated(exit_code, message))
        api.logs[f"{name}-x"] = "waypoint 1 of 1 reached at 3.00 s\n"
        api.end(name, kind)

    api.at_look(2, action)


def test_a_flight_on_a_cluster_writes_a_whole_run(ready, tmp_path, call):
    (tmp_path / "two.py").write_text("UNIT = '1'\ndef measure(flight):\n    return 2.0\n")
    ends(ready)
    # The recording was made in virtual time, so it does not prove real time.
    captured = call(f"{LINE} --out out --set report.metrics=./two.py", code=6)
    assert "waypoint 1 of 1 reached" in captured.err
    report = json.loads(captured.out)
    assert report["verdict"] == "invalid"
    assert (report["mode"], report["shaper"]) == ("cluster", "relay")
    assert report["complete"]
    assert report["numbers"]["waypoints_reached"]["value"] == 1
    assert report["numbers"]["two"]["value"] == 2.0, "measured here, not in a pod"
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"config.yaml", "mission.mcap", "report.json", "environment.json"} <= left
    assert {"world.mcap", "cloud.mcap", "cloud-teleop.log"} <= left
    assert not (tmp_path / "runs").exists()
    given = json.loads((tmp_path / "values").read_text())
    assert (given["experiment"]["name"], given["metrics"]) == (NAME, BEFORE["metrics"])
    assert given["mission"] == {"enabled": False, "queue": True}, "only the run's own mission flies"
    line = (tmp_path / "helm").read_text()
    assert "upgrade --install cloudrc " in line
    assert "--namespace=demo --create-namespace" in line


@pytest.mark.parametrize(
    ("before", "tag"),
    [
        ({}, "0.1.0-g2"),
        ({"image": {"tag": "0.1.0-g1", "pullPolicy": "Never"}}, "0.1.0-g2"),
        ({"image": {"tag": "mine"}}, "mine"),
        ({"image": {"registry": "lab"}}, None),
    ],
)
def test_a_rebuilt_image_that_was_loaded_restarts_the_pods(release, tmp_path, before, tag):
    assert loaded_tag(release, tmp_path) == ""
    (tmp_path / "build" / "loaded").mkdir(parents=True)
    (tmp_path / "build" / "loaded" / "here").write_text("0.1.0-g2\n")
    loaded = loaded_tag(release, tmp_path)
    image = chart_values(load_experiment(NAME), before, {}, loaded).get("image", {})
    assert image == {**before.get("image", {}), **({"tag": tag} if tag else {})}


def test_the_users_robot_and_scene_fly_as_configmaps_that_belong_to_the_release(
    ready, tmp_path, call
):
    shutil.copytree(FOLDERS["robot"] / "pelican", tmp_path / "mine")
    shutil.copy(SCENES / "empty.xml", tmp_path / "lab.xml")
    ends(ready)
    call(f"{LINE} --out out --set world.robot=./mine --set world.scene=./lab.xml", code=6)
    given = json.loads((tmp_path / "values").read_text())
    names = {kind: given[kind]["configMap"] for kind in ("robot", "scene")}
    assert "robot" not in given["experiment"]["world"]
    assert "robot.yaml" in ready.get("configmaps", names["robot"])["binaryData"]
    assert "scene.xml" in ready.get("configmaps", names["scene"])["binaryData"]
    patched = (tmp_path / "patched").read_text()
    assert all(f"patch configmap {name}" in patched for name in names.values())
    assert ready.get("deployments", "cloudrc-world")["metadata"]["uid"] in patched


def test_a_refused_mission_leaves_no_run(ready, tmp_path, call):
    ends(ready, "Failed", 5, "mission m-1 is under way")
    said = call(LINE, code=5).err
    assert "did not fly its mission: mission m-1 is under way" in said
    assert "what was recorded" not in said
    assert list((tmp_path / "runs").glob("*")) == []


@pytest.mark.parametrize("left", ["", "before\n"])
def test_the_recording_from_before_a_restart_is_copied(ready, tmp_path, call, left):
    ends(ready)
    if left:
        (tmp_path / "left").write_text(left)
    call(LINE, code=6)
    found = (tmp_path / "runs" / "latest").glob("*.before.mcap")
    wanted = {"world.before.mcap": left} if left else {}
    assert {path.name: path.read_text() for path in found} == wanted


def test_an_interrupted_flight_cancels_and_reports_its_mission(
    ready, teleop, tmp_path, call, monkeypatch
):
    teleop.missions = lambda: missions_of(ready)  # none once the Job is deleted
    monkeypatch.setattr(flight, "follow", Mock(side_effect=KeyboardInterrupt))
    record(tmp_path, [each[: len(each) // 2] for each in flown()], torn=False)
    captured = call(f"{LINE} --out out", code=130)
    assert "cancelling the mission" in captured.err
    assert "DELETE jobs/" in " ".join(ready.seen)
    assert teleop.posted == ["/v1/missions/m4/cancel"]
    report = json.loads(captured.out)
    assert (report["mode"], report["verdict"]) == ("cluster", "interrupted")


def test_a_run_does_not_end_a_flight_in_progress(ready, teleop, tmp_path, call):
    teleop.mission = {"id": "m7"}
    said = call(f"{LINE} --out out", code=5).err
    assert "mission m7 is under way on release 'cloudrc'" in said
    assert "end it: cloudrc mission cancel m7 --namespace=demo --release=cloudrc, or" in said
    run_job(connect(), {}, name="first")
    assert "Job 'first' is under way" in call(f"{LINE} --out out", code=5).err
    assert not (tmp_path / "helm").exists()
    assert not (tmp_path / "out").exists()
