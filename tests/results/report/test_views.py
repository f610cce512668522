# SPDX-License-Identifier: Apache-2.0

"""Topics for viewers show robot, scene and path; a report ignores these topics."""

import json
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from cloudrc.config.load import load_experiment
from cloudrc.flight.fly import fly
from cloudrc.physics.geometry.scene import load_scene
from cloudrc.results.record.columns import Recording

LAYOUT = Path(__file__).resolve().parents[3] / "docs" / "cloudrc.foxglove.json"
SHORT = ("mission.waypoints=[{position_m: [0.5, 0, 0.7], dwell_s: 1.0}]", "mission.touch=null")


@pytest.fixture(scope="module")
def flown(tmp_path_factory):
    """Fly in virtual time; return the recording's path, the report, and messages by topic."""
    folder = tmp_path_factory.mktemp("run")
    report = fly(load_experiment("paper", SHORT), "virtual", folder, page=False)
    path, messages = folder / "mission.mcap", defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, raw, message in reader.iter_decoded_messages():
            messages[channel.topic].append((raw.log_time, message))
    return path, report, messages


def xyz(vectors):
    return np.array([(each.x, each.y, each.z) for each in vectors])


def transforms(messages, frame):
    """Return stamps [ns] and transforms of a frame."""
    sent = [each for _, message in messages["/tf"] for each in message.transforms]
    found = [each for each in sent if each.child_frame_id == frame]
    assert {each.header.frame_id for each in found} == {"world"}
    stamps = [each.header.stamp.sec * 10**9 + each.header.stamp.nanosec for each in found]
    return np.array(stamps), [each.transform for each in found]


def test_frames_are_the_poses_of_the_recording(flown):
    path, _, messages = flown
    recording = Recording.read(path)
    for frame, topic, column in (
        ("base_link", "/ground_truth", "position"),
        ("estimate", "/estimated_odometry", "position"),
        ("setpoint", "/setpoint_position", "setpoint"),
    ):
        stamps, poses = transforms(messages, frame)
        table = recording[topic]
        rows = np.searchsorted(table["stamp_ns"], stamps)
        np.testing.assert_array_equal(table["stamp_ns"][rows], stamps)
        np.testing.assert_array_equal(table[column][rows], xyz(e.translation for e in poses))
        if frame != "setpoint":
            turns = [(e.rotation.w, *xyz([e.rotation])[0]) for e in poses]
            np.testing.assert_array_equal(table["orientation_wxyz"][rows], turns)
        assert np.diff(stamps).max() <= 50_000_000, "smooth enough to be interpolated"


def test_the_scene_has_robot_pipes_board_and_path(flown):
    path, _, messages = flown
    ((began_ns, message),) = messages["/scene"]
    truth, scene = Recording.read(path)["/ground_truth"], load_scene("pipes")
    assert began_ns == truth["stamp_ns"][0]
    markers = defaultdict(list)
    for marker in message.markers:
        assert marker.frame_locked, "it moves with its frame"
        markers[marker.ns, marker.header.frame_id].append(marker)
    fixed = {(name, "world") for name in ("board", "path", *(pipe.name for pipe in scene.tubes))}
    moving = {("robot", "base_link"), ("estimate", "estimate"), ("setpoint", "setpoint")}
    assert markers.keys() == fixed | moving
    assert len({marker.id for marker in message.markers}) == len(message.markers)
    for pipe in scene.tubes:
        (tube,) = markers[pipe.name, "world"]
        points = xyz(tube.points) - pipe.centre
        np.testing.assert_allclose(np.abs(points @ pipe.axis), pipe.length / 2, atol=1e-5)
        radii = np.linalg.norm(np.cross(points, pipe.axis), axis=1)
        np.testing.assert_allclose(radii, pipe.inner, atol=1e-5)
    (line,) = markers["path", "world"]
    ends = truth["position"][[0, -1]]
    np.testing.assert_allclose(xyz(line.points)[[0, -1]], ends, atol=0.05)


def test_every_path_of_the_layout_is_in_a_recording(flown):
    layout, messages = json.loads(LAYOUT.read_text()), flown[2]
    for panel in layout["configById"].values():
        for value in (
            *(path["value"] for path in panel.get("paths", [])),
            *panel.get("topics", {}),
        ):
            topic, *names = value.split(".")
            assert messages[topic], value
            for _, message in messages[topic]:
                for name in names:
                    message = getattr(message, name)
                assert not names or isinstance(message, int | float | str), value
    shown = re.findall(r"'(\w+!\w+)'", str(layout["layout"]))
    assert sorted(shown) == sorted(layout["configById"]), "every panel has its place"
    frames = {
        name.removeprefix("frame:") for name in layout["configById"]["3D!cloudrc"]["transforms"]
    }
    assert frames == {"world", "base_link", "estimate", "setpoint"}
