# SPDX-License-Identifier: Apache-2.0

"""A run is repeated from its config.yaml: files that changed since its flight are named."""

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.flight.own_files import describe_changes, hash_files
from tests.support.own_flight import PREDICTOR, fly_own


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Fly with files of one's own; return the config.yaml of the run, and the folder of files."""
    folder, files = fly_own(tmp_path_factory)
    return folder / "config.yaml", files


@pytest.mark.parametrize(
    ("file", "key"),
    [
        ("robot/robot.yaml", "world.robot"),
        ("robot/robot.xml", "world.robot"),
        ("scene.xml", "world.scene"),
        ("mine.py", "cloud.predictor.name"),
    ],
)
def test_a_changed_file_is_named_with_both_hashes(run, file, key):
    config, files = run
    path, experiment = files / file, load_experiment(config)
    assert describe_changes(str(config), experiment) == ""
    before, then = path.read_text(), hash_files(experiment)[key]
    path.write_text(before + {".py": "# new\n", ".xml": "<!-- new -->"}.get(path.suffix, "# new\n"))
    try:
        text, now = describe_changes(str(config), experiment), hash_files(experiment)[key]
    finally:
        path.write_text(before)
    assert f"{key} (then {then}, now {now})" in text
    assert text.count("then") == 1
    assert "\n" not in text


def test_files_that_a_setting_replaces_do_not_count(run, tmp_path):
    config, _ = run
    (tmp_path / "other.py").write_text(PREDICTOR + "# other\n")
    settings = ["world.robot=rover", f"cloud.predictor={tmp_path / 'other.py'}"]
    assert describe_changes(str(config), load_experiment(config, settings)) == ""
