"""A run is drawn from its recording, without the user's files of robot and scene."""

import shutil

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.geometry.shapes import SHAPES_FILE
from cloudrc.record.columns import Recording
from cloudrc.report.shapes import flown_shapes
from cloudrc.runs.fly import fly
from cloudrc.world.shapes import read_shapes


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Fly the user's own rover; return the folders of the run and of the user's files."""
    files = tmp_path_factory.mktemp("mine")
    shutil.copytree(find_robot("rover").model.parent, files / "robot")
    shutil.copy(file_of("pillars"), files / "scene.xml")
    folder = tmp_path_factory.mktemp("run")
    sets = (
        f"world.robot={files / 'robot'}",
        f"world.scene={files / 'scene.xml'}",
        "mission.waypoints=[{position_m: [0.5, 0.5], dwell_s: 0.0}]",
    )
    experiment = load_experiment("pillars", sets)
    fly(experiment, "virtual", folder, page=False)
    return folder, files, experiment


def test_the_recording_has_the_shapes_and_a_copy_keeps_them(run, tmp_path):
    folder, _, experiment = run
    recording = Recording.read(folder / "mission.mcap")
    wanted = read_shapes(experiment.world).to_bytes()
    assert recording.attachments[SHAPES_FILE] == wanted
    recording.write(tmp_path / "copy.mcap")
    assert Recording.read(tmp_path / "copy.mcap").attachments[SHAPES_FILE] == wanted


def test_the_recordings_own_shapes_count_and_not_those_of_changed_files(run):
    folder, files, experiment = run
    recording, model = Recording.read(folder / "mission.mcap"), files / "robot" / "robot.xml"
    before, text = flown_shapes(recording, experiment), model.read_text()
    model.write_text(
        text.replace('name="mast" type="cylinder" size=".02', 'type="cylinder" size=".2')
    )
    try:
        assert flown_shapes(recording, experiment).to_bytes() == before.to_bytes()
        recording.attachments.clear()
        assert flown_shapes(recording, experiment).to_bytes() != before.to_bytes()
    finally:
        model.write_text(text)
