# SPDX-License-Identifier: Apache-2.0

"""A run is drawn and reported from its recording, without the user's files of robot and scene."""

import json

import pytest

from cloudrc.config.load import read_experiment
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.figures import FIGURES
from cloudrc.results.report.flown import flown_shapes
from tests.support.own_flight import fly_own


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return fly_own(tmp_path_factory)


def test_the_recordings_own_shapes_count_and_not_those_of_changed_files(run):
    folder, files = run
    experiment = read_experiment(folder / "config.yaml", flown=True)
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


def measured(folder):
    """Return the numbers of a report; the last bit depends on how the memory is laid out."""
    numbers = json.loads((folder / "report.json").read_text())["numbers"]
    return {name: float(f"{number['value']:.9g}") for name, number in numbers.items()}


def test_the_report_of_a_flight_names_the_body_that_nothing_can_touch(run):
    notes = json.loads((run[0] / "report.json").read_text())["notes"]
    assert [note for note in notes if note.startswith("The robot flies through ghost: ")]


def test_a_report_is_that_of_the_flight_without_the_users_files(run, call, monkeypatch):
    monkeypatch.setattr("cloudrc.results.report.figures.FIGURES", {"flight": FIGURES["flight"]})
    folder, files = run
    before = measured(folder)
    away = files.rename(files.with_name("away"))
    try:
        call("report", folder)
    finally:
        away.rename(files)
    assert measured(folder) == before
    assert "min_clearance_flight" in before
    assert "No replay in 3-D" not in (folder / "report.html").read_text()
