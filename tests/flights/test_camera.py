# SPDX-License-Identifier: Apache-2.0

"""Pictures of the robot's camera reach cloud, as late as the link lets them; the rest stays.

A camera that draws when a picture was taken stands in for the renderer, which
`tests/physics/sim` has.
"""

from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from cloudrc.flight.assembly.cloud import build_cloud
from cloudrc.flight.assembly.link import build_links
from cloudrc.flight.assembly.world import build_world
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.flight.virtual.flight import fly_virtual, start_mission
from cloudrc.flight.virtual.run import VirtualRun
from cloudrc.results.metrics.age import describe, sawtooth
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.results.record.writer import McapWriter
from cloudrc.wire.pictures import make_decoder
from cloudrc.wire.tunnel.end import Identity
from tests.conftest import nightly
from tests.flights.conftest import ring, sha256
from tests.support.camera import needs_renderer
from tests.support.commands import python

pytestmark = pytest.mark.usefixtures("shared_files")

SHORT, BRIEF = (
    f"mission.waypoints=[{{position_m: [0, 0, 1], dwell_s: {seconds}, tolerance_m: 1}}]"
    for seconds in (4, 1)
)
FILM = ("world.robot=x2", "world.scene=empty", SHORT, "camera.codec=jpeg")
BITS = 40
"""Number of squares in a picture; they are white where a bit of its time in ms is 1."""


class Clock:
    """A camera of 8 x 5 squares, which tell when it was aimed."""

    def __init__(self, model, data, config):
        self.config, self._data, self._time = config, data, 0

    def aim(self):
        self._time = round(self._data.time * 1e3)

    def render(self):
        bits = np.array([self._time >> bit & 1 for bit in range(BITS)]).reshape(5, 8)
        tall, wide = self.config.height // 5, self.config.width // 8
        squares = np.kron(bits, np.ones((tall, wide))) * 255
        return np.repeat(squares[:, :, None], 3, axis=2).astype(np.uint8)


def time_in(image):
    """Return the time in a picture [ms]."""
    tall, wide = image.shape[0] // 5, image.shape[1] // 8
    bits = image[tall // 2 :: tall, wide // 2 :: wide, 0].ravel() > 127
    return sum(1 << bit for bit in np.flatnonzero(bits).tolist())


@pytest.fixture(autouse=True)
def clock(monkeypatch):
    monkeypatch.setattr("cloudrc.physics.sim.camera.Camera", Clock)


def load(*settings):
    """Load an experiment with a camera; of two settings of a key the last one counts."""
    found = {each.partition("=")[0]: each for each in (*FILM, *settings)}
    return load_experiment("hover", [*found.values()])


@cache
def flown(*settings):
    """Fly in virtual time, and measure; tests of the same flight share it."""
    return fly_in_memory(load(*settings))


def fly(*settings):
    """Return the recording of a flight."""
    return flown(*settings).flight.recording


def numbers(*settings):
    """Return the numbers of a flight."""
    return {name: each.value for name, each in flown(*settings).numbers.items()}


@pytest.mark.parametrize("codec", ["jpeg", "h264"])
def test_over_an_ideal_link_cloud_has_every_picture_as_the_codec_leaves_it(codec):
    settings = "link.profile=ideal", f"camera.codec={codec}", "camera.keep=true"
    flight = fly(*settings)
    sent, shown, kept = (flight[name] for name in ("/frame", "/frame_shown", "/camera"))
    assert len(sent) == len(shown) == len(kept) > 50
    assert (shown["stamp_ns"] == sent["taken_ns"]).all()
    decoder = make_decoder("jpeg")  # it reads PNG, too
    seen = [time_in(decoder.decode(data)) for data in kept["data"]]
    since = sent["taken_ns"] // 1_000_000
    of_mission = sent["epoch"] == sent["epoch"][-1]
    apart = (since - seen)[of_mission]
    assert (apart == apart[0]).all(), "a picture of another moment"
    found = numbers(*settings)
    assert found["frames_shown"] == 1.0
    flown = sent["taken_ns"] > shown["taken_ns"][0] + 10**9
    assert found["frame_psnr"] == pytest.approx(sent["psnr"][flown].mean(), abs=1.0)


def test_pictures_are_taken_at_the_first_step_of_their_period():
    taken = fly("link.profile=ideal")["/frame"]["taken_ns"]
    since = taken[-60:] - taken[-60]
    steps = np.diff(since) // 1_000_000
    assert {*steps.tolist()} == {66, 68}
    assert abs(since[-1] * 1e-9 - 59 / 15) <= 0.002


def test_with_one_packet_a_picture_its_age_is_the_age_of_information(tmp_path):
    """Pictures of 16 x 16 fit one packet: their age is that of the link's arrivals."""
    link = ("link.uplink.delay_ms=40", "link.uplink.jitter_ms=20", "link.uplink.loss=0.1")
    robot = small_robot(tmp_path)
    experiment = load(*link, f"world.robot={robot}")
    flight = fly(*link, f"world.robot={robot}")
    sent = flight["/frame"]
    assert set(sent["pieces"]) == {1}
    up, _ = build_links(experiment)
    rows = np.stack([sent[name] for name in ("epoch", "counter", "size", "taken_ns")]).T.tolist()
    arrivals = [(a, at) for e, n, size, at in rows for a in up.send(e, 10, n, size + 49, at)]
    arrived_ns, taken_ns = np.array(sorted(arrivals)).T
    shown = flight["/frame_shown"]
    newest = np.maximum.accumulate(taken_ns)
    for at_ns in range(2 * 10**9, int(arrived_ns[-1]), 10**8):
        seen = shown["taken_ns"][shown["stamp_ns"].searchsorted(at_ns, "right") - 1]
        assert seen == newest[arrived_ns.searchsorted(at_ns, "right") - 1]
    end_ns = int(arrived_ns[-1])
    edges_ns = np.unique(arrived_ns[arrived_ns <= end_ns])
    expected = describe(sawtooth(edges_ns, arrived_ns, newest))["mean"]
    edges_ns = np.unique(shown["stamp_ns"])
    assert describe(sawtooth(edges_ns, shown["stamp_ns"], shown["taken_ns"]))[
        "mean"
    ] == pytest.approx(expected, rel=1e-3)


def small_robot(folder):
    """Return the folder of an x2 whose pictures have 16 x 16 pixels."""
    x2 = Path("cloudrc/robots/x2").resolve()
    text = (x2 / "robot.yaml").read_text().replace("fovy_deg: 60", "fovy_deg: 60, width: 16")
    (folder / "robot.yaml").write_text(text.replace("width: 16", "width: 16, height: 16"))
    (folder / "robot.xml").write_bytes((x2 / "robot.xml").read_bytes())
    return folder


def test_a_flight_repeats_to_the_bit_also_with_encrypted_bytes():
    settings = (BRIEF, "link.profile=lte", "camera.keep=true")
    experiment, first = load(*settings), fly(*settings)
    assert sha256(experiment) == first.sha256 != sha256(load(*settings, "seed=2"))
    identity = Identity(bytes(16), bytes(16), ring())
    world, teleop = build_world(experiment, identity), start_mission(experiment)
    cloud, store = build_cloud(experiment, identity, teleop), RecordStore()
    run = VirtualRun(world, cloud, *build_links(experiment))
    run.fly(lambda: teleop.over, 60_000_000_000, store.add)
    assert Recording(records=store).sha256 == first.sha256


@needs_renderer
@pytest.mark.parametrize("codec", [*nightly("jpeg"), "h264"])
def test_a_flight_with_the_real_renderer_repeats_to_the_bit(codec, monkeypatch):
    if codec == "h264":
        pytest.importorskip("av", reason="PyAV comes with the extra camera")
    monkeypatch.undo()  # the fixture `clock`
    settings = (f"camera.codec={codec}", "mission.follow.duration_s=1")
    experiment = load_experiment("follow", settings)
    first, second = (fly_in_memory(experiment) for _ in range(2))
    kept, again = ([*each.flight.recording["/camera"]["data"]] for each in (first, second))
    assert kept == again
    assert len({*kept}) > 12, "the board moves: a second of different pictures"
    assert second.records_sha256 == first.records_sha256
    assert second.verdict == first.verdict
    assert second.numbers == first.numbers


def test_the_rest_of_a_flight_keeps_every_bit():
    plain = load_experiment("hover", [*FILM[:2], BRIEF])
    assert "camera" not in plain.model_dump(mode="json")
    store = RecordStore()
    fly_virtual(plain, store.add)
    without, filmed = Recording(records=store), fly(BRIEF)
    assert not any(len(without[name]) for name in ("/frame", "/frame_shown", "/camera"))
    for topic in ("/ground_truth", "/cmd_vel", "/uplink_delay"):
        for name, column in without[topic].columns.items():
            assert np.array_equal(column, filmed[topic][name], equal_nan=True), (topic, name)


def test_a_loss_costs_h264_all_pictures_up_to_the_next_key_frame():
    link = ("link.uplink.loss=0.05", "link.uplink.delay_ms=20")
    stands = numbers(*link)
    needs = numbers(*link, "camera.codec=h264", "camera.key_every_s=2")
    assert stands["frames_shown"] > needs["frames_shown"] > 0.0
    assert stands["frame_age_max"] < needs["frame_age_max"]


@pytest.mark.parametrize("queue", ["fifo", "priority", "newest"])
def test_a_cell_with_priority_sends_telemetry_before_pictures(queue):
    from cloudrc.flight.fleet import assemble_fleet

    cell = ("cell.rate_kbit=900", f"cell.queue={queue}")
    settings = (*cell, "link.profile=ideal", "camera.quality=95")
    fleet = load(*settings)
    store, end_ns = RecordStore(), 4 * 10**9
    run = assemble_fleet(fleet, [fleet], [store.add])
    run.fly(lambda now_ns: now_ns > end_ns)
    flight = Recording(records=store)
    waits = flight["/cell_wait"]
    telemetry = waits["wait_ns"][waits["uplink"]]
    piece_ns = 1228 * 8e9 / 900e3
    # The packet in service is not interrupted.
    if queue != "newest":  # there newer telemetry takes the place of what waits
        assert (telemetry.max() < 1.5 * piece_ns) == (queue == "priority")
    assert len(flight["/frame_shown"]) > 0.9 * len(flight["/frame"]), "none replaces another"


PERCEPTION = """
from cloudrc.cloud.perceptions import Frame, Perception
from cloudrc.wire.messages import Setpoint

class Sees(Perception):
    takes = {takes!r}
    def see(self, seen, odometry):
        assert isinstance(seen, Frame) and seen.image.shape == (240, 320, 3)
        assert odometry.stamp_ns <= seen.stamp_ns < odometry.stamp_ns + 20_000_000
        return Setpoint((1.0, 0.0, 1.0))

def build():
    return Sees()
"""


def test_a_perception_gets_pictures_and_flies_by_them(tmp_path):
    path = tmp_path / "sees.py"
    path.write_text(PERCEPTION.format(takes="camera"))
    settings = (f"cloud.perception={path}", "link.profile=lte", "cloud.perception_ms=30")
    flight = fly(*settings)
    assert not [*flight["/fault"]["code"]]
    seen = flight["/perception"]
    assert set(seen["compute_ns"]) == {30_000_000}
    steered = (flight["/setpoint_position"]["setpoint"] == (1.0, 0.0, 1.0)).all(axis=1)
    assert steered.mean() > 0.5
    found = numbers(*settings)
    assert found["seen_to_acted"] > found["frame_age_mean"] > 0.03


@pytest.mark.parametrize(
    ("settings", "where"),
    [
        (["world.robot=rover", "mission.waypoints=[{position_m: [1, 0]}]"], "camera"),
        (["camera.codec=mjpeg"], "camera.codec"),
        (["camera.quality=0"], "camera.quality"),
        (["camera.kbit=300"], "--set: camera.kbit: 300: has no effect with codec jpeg; set camera"),
        (["camera={key_every_s: 2}"], "key_every_s: 2: has no effect with codec jpeg"),
        (["fleet.robots=2"], "camera"),
        (["cloud.perception=gap"], "'gap' takes scans, but x2 has no scanner"),
        (["world.scan=true"], "world.scan: true: x2 has no scanner"),
        (["cloud.perception=PATH"], "takes must be scan or camera"),
    ],
)
def test_bad_input_is_refused_in_one_line(settings, where, tmp_path):
    path = tmp_path / "sees.py"
    path.write_text(PERCEPTION.format(takes="sonar"))
    with pytest.raises(BadInputError) as refused:
        load(*(each.replace("PATH", str(path)) for each in settings))
    assert where in str(refused.value)
    assert "\n" not in str(refused.value)


def test_a_file_may_hold_the_keys_of_both_codecs(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text(dump(load_experiment("follow", ["camera.codec=h264", "camera.kbit=300"])))
    camera = load_experiment(path, ["camera.codec=jpeg"]).camera
    assert (camera.codec, camera.kbit, camera.quality) == ("jpeg", 300, 70)


def test_a_setting_of_jpeg_has_no_effect_with_h264():
    text = "--set: camera.quality: 50: has no effect with codec h264; set camera.codec=jpeg"
    with pytest.raises(BadInputError, match=text):
        load_experiment("follow", ["camera.codec=h264", "camera.quality=50"])


def test_a_camera_that_the_robot_does_not_have_is_named_and_not_the_perception_of_scans():
    with pytest.raises(BadInputError, match=r"camera: jpeg: rover has no camera: leave camera out"):
        load_experiment("gap", ["camera.codec=jpeg"])


def test_a_perception_of_scans_beside_a_camera_needs_world_scan(tmp_path):
    rover = Path("cloudrc/robots/rover").resolve()
    (tmp_path / "robot.xml").write_bytes((rover / "robot.xml").read_bytes())
    text = (rover / "robot.yaml").read_text()
    (tmp_path / "robot.yaml").write_text(f"{text}\ncamera: {{name: front}}\n")
    settings = [f"world.robot={tmp_path}", "camera.codec=jpeg"]
    with pytest.raises(BadInputError, match=r"'gap' takes scans: set world.scan=true"):
        load_experiment("gap", settings)
    assert load_experiment("gap", [*settings, "world.scan=true"]).scans


def test_a_perception_of_pictures_needs_a_camera(tmp_path):
    path = tmp_path / "sees.py"
    path.write_text(PERCEPTION.format(takes="camera"))
    with pytest.raises(BadInputError, match=r"camera: {codec: jpeg}"):
        load_experiment("hover", [*FILM[:-1], f"cloud.perception={path}"])


@pytest.mark.parametrize(
    ("key", "value"),
    [("fps", 101), ("width", 1922), ("height", 1082), ("name", "back"), ("fovy_deg", 45)],
)
def test_a_camera_that_cannot_be_is_refused(tmp_path, key, value):
    from cloudrc.robots.build import check_robot

    x2 = Path("cloudrc/robots/x2").resolve()
    (tmp_path / "robot.xml").write_bytes((x2 / "robot.xml").read_bytes())
    camera = {"name": "front", "fovy_deg": 60} | {key: value}
    lines = (x2 / "robot.yaml").read_text().splitlines()
    kept = [line for line in lines if not line.startswith("camera:")]
    (tmp_path / "robot.yaml").write_text("\n".join([*kept, f"camera: {camera}"]))
    with pytest.raises(BadInputError) as refused:
        check_robot(load_experiment("hover", [f"world.robot={tmp_path}"]).world)
    assert f"camera.{key}" in str(refused.value)


def test_a_recording_gives_back_the_pictures(tmp_path):
    experiment = load(BRIEF, "camera.keep=true", "link.profile=ideal")
    store = RecordStore()
    with McapWriter(tmp_path / "a.mcap", clock="world") as writer:

        def see(*records):
            store.add(*records)
            writer.write([*records[0], *records[1]])

        fly_virtual(experiment, see)
    made, read = Recording(records=store), Recording.read(tmp_path / "a.mcap")
    assert read.sha256 == made.sha256
    assert read["/camera"]["data"][-1] == made["/camera"]["data"][-1]


def test_a_flight_without_a_camera_loads_no_renderer_and_no_codec():
    program = (
        "import sys; from cloudrc.config.load import load_experiment as load;"
        "from cloudrc.flight.in_memory import fly_in_memory as fly;"
        f"fly(load('hover', ['world.robot=x2', 'world.scene=empty', '{BRIEF}']));"
        "print({'cloudrc.physics.sim.camera', 'av', 'OpenGL', 'mujoco.egl'} & sys.modules.keys())"
    )
    found = python("-c", program)
    assert found.stdout == "set()\n", found.stderr
