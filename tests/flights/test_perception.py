# SPDX-License-Identifier: Apache-2.0

"""The rover drives by its scans, as late as cloud has them; other flights keep every bit."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.flight.assembly.cloud import build_cloud
from cloudrc.flight.assembly.link import build_links
from cloudrc.flight.assembly.world import build_world
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.flight.virtual.flight import fly_virtual, start_mission
from cloudrc.flight.virtual.run import VirtualRun
from cloudrc.physics.geometry.rays import ranges_of
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.record.writer import McapWriter
from cloudrc.wire.records import Perceived, ScanTaken
from cloudrc.wire.tunnel.end import Identity
from tests.flights.conftest import ring

pytestmark = pytest.mark.usefixtures("shared_files")

SHORT = ("mission.waypoints=[{position_m: [2, 0], tolerance_m: 0.5}]",)
LATE = ("link.both.delay_ms=300",)


def fly(experiment):
    """Fly in virtual time; return the recording."""
    store = RecordStore()
    fly_virtual(experiment, store.add)
    return Recording(records=store)


@cache
def gap(*settings):
    """Return the recording of a flight; tests of the same flight share it."""
    return fly(load_experiment("gap", settings))


def verdict(*settings):
    """Return the codes of a flight's failures, past four of the pillars."""
    way = "mission.waypoints=[{position_m: [10, 0], tolerance_m: 0.5}]", "criteria.time_limit_s=20"
    found = fly_in_memory(load_experiment("gap", [*way, *settings])).verdict
    return {failure.code for failure in found.failures}


def test_gap_passes_without_delay_and_with_prediction_and_touches_without_it():
    assert verdict() == set()
    assert verdict(*LATE) == set()
    assert "obstacle_touched" in verdict(*LATE, "cloud.predictor=last_sample")


def test_a_flight_repeats_to_the_bit():
    first = gap(*SHORT)
    again = gap.__wrapped__(*SHORT)
    assert again.sha256 == first.sha256 != gap(*SHORT, "seed=2").sha256
    scans = first["/scan"]
    assert (np.diff(scans["stamp_ns"][1:]) == 100_000_000).all()
    assert scans["ranges"].shape == (len(scans), 181)


def test_scans_are_taken_at_the_first_step_of_their_period(tmp_path):
    folder = tmp_path / "fast"
    folder.mkdir()
    rover = Path("cloudrc/robots/rover").resolve()
    text = (rover / "robot.yaml").read_text().replace("rate_hz: 10", "rate_hz: 30")
    (folder / "robot.yaml").write_text(text)
    (folder / "robot.xml").write_bytes((rover / "robot.xml").read_bytes())
    scans = gap(*SHORT, f"world.robot={folder}")["/scan"]
    since = scans["stamp_ns"][1:] - scans["stamp_ns"][1]  # the mission has a session of its own
    assert since[:4].tolist() == [0, 34_000_000, 68_000_000, 100_000_000]


def test_objects_and_encrypted_bytes_make_the_same_records():
    experiment, identity = load_experiment("gap", SHORT), Identity(bytes(16), bytes(16), ring())
    world, teleop = build_world(experiment, identity), start_mission(experiment)
    cloud = build_cloud(experiment, identity, teleop)
    store = RecordStore()
    run = VirtualRun(world, cloud, *build_links(experiment))
    run.fly(lambda: teleop.over, 60_000_000_000, store.add)
    assert Recording(records=store).sha256 == gap(*SHORT).sha256


def test_a_recording_gives_back_scans_and_what_became_of_them(tmp_path):
    ranges = np.float32(ranges_of((1234, 0, 9999))).astype(float)
    world = [ScanTaken(k, 1, k, -0.5, 0.25, 0.125, 10.0, ranges) for k in (1, 2)]
    cloud = [Perceived(9, 1, 2, 3, 4, 1, 5, (1.0, 2.0, 3.0))]
    with McapWriter(tmp_path / "a.mcap", clock="world") as writer:
        writer.write([*world, *cloud])
    read, made = Recording.read(tmp_path / "a.mcap"), Recording.from_records(world, cloud)
    assert read.sha256 == made.sha256
    assert read["/scan"]["ranges"].tolist() == [ranges.tolist()] * 2
    assert read["/perception"]["compute_ns"].tolist() == [3]


def test_the_perception_is_a_stage_of_the_delay_and_delays_no_command():
    flight = gap(*SHORT, "cloud.perception_ms=250")
    seen = flight["/perception"]
    assert set(seen["compute_ns"]) == {250_000_000}
    assert (np.diff(flight["/cmd_vel"]["stamp_ns"]) == 10_000_000).all()
    steered = seen["counter"] >= 0
    assert steered.mean() > 0.8
    (number,) = {*flight["/count"]["total"][flight["/count"]["name"] == "seen_dropped"][-1:]}
    assert len(seen) + number >= len(flight["/scan"]) - 3


def test_a_perception_that_fails_is_told_once_and_its_last_setpoint_stays(tmp_path):
    path = tmp_path / "bad.py"
    path.write_text(
        "from cloudrc.cloud.perceptions import Perception\n"
        "class Bad(Perception):\n"
        "    def see(self, seen, odometry):\n"
        "        return 1 / 0\n"
        "def build(): return Bad()\n"
    )
    flight = gap(*SHORT, f"cloud.perception={path}")
    faults = [*flight["/fault"]["code"]]
    assert faults.count("perception_failed") == 1
    counts = flight["/count"]
    assert counts["total"][counts["name"] == "perception_failed"].max() > 5


@pytest.mark.parametrize(
    ("settings", "where"),
    [
        (["world.robot=pelican"], "cloud.perception"),
        (["world.robot=nano", "cloud.perception=null", "world.scan=true"], "world.scan"),
        (["cloud.perception=gaps"], "cloud.perception"),
        (["cloud.perception.radius_m=0"], "cloud.perception.radius_m"),
        (["cloud.perception=null", "cloud.perception_ms=5"], "cloud"),
        (["mission.waypoints.0.position_m=[5, -0.4]"], "mission.waypoints.0"),
        (["cloud.perception=null"], "mission.waypoints.0"),
    ],
)
def test_bad_input_is_refused_in_one_line(settings, where):
    with pytest.raises(BadInputError) as refused:
        load_experiment("gap", settings)
    assert where in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(("key", "value"), [("rays", 542), ("rate_hz", 101), ("site", "nose")])
def test_a_scanner_that_cannot_be_is_refused(tmp_path, key, value):
    from cloudrc.robots.build import check_robot

    rover = Path("cloudrc/robots/rover").resolve()
    (tmp_path / "robot.xml").write_bytes((rover / "robot.xml").read_bytes())
    scan = {"site": "lidar"} | {key: value}
    lines = (rover / "robot.yaml").read_text().splitlines()
    kept = [line for line in lines if not line.startswith("scan:")]
    (tmp_path / "robot.yaml").write_text("\n".join([*kept, f"scan: {scan}"]))
    with pytest.raises(BadInputError) as refused:
        check_robot(load_experiment("gap", [f"world.robot={tmp_path}"]).world)
    assert f"scan.{key}" in str(refused.value)


def test_a_flight_without_a_perception_has_the_hash_of_before():
    """The rover has a scanner now: only an experiment that uses it changes."""
    short = "mission.waypoints=[{position_m: [1.5, 1.2]}]"
    plain = load_experiment("pillars", [short])
    assert "scan" not in plain.model_dump(mode="json")["world"]
    assert plain.model_dump(mode="json")["cloud"].keys().isdisjoint({"perception", "perception_ms"})
    flight = fly(plain)
    scanning = fly(load_experiment("pillars", [short, "world.scan=true"]))
    assert not len(flight["/scan"])
    for topic in ("/ground_truth", "/cmd_vel", "/uplink_delay"):
        for name, column in flight[topic].columns.items():
            assert np.array_equal(column, scanning[topic][name], equal_nan=True), (topic, name)
