# SPDX-License-Identifier: Apache-2.0

"""The hash of the code depends on all sources that a flight can run, and on nothing else."""

import shutil
from pathlib import Path

import pytest

import cloudrc
from cloudrc import source
from tests.support.programs import loaded

PACKAGE = Path(cloudrc.__file__).parent


@pytest.fixture
def hash_of(monkeypatch):
    """Return a function: path of a package (a folder, or inside a zip file) -> its hash."""

    def compute(package):
        monkeypatch.setattr(source, "files", lambda name: package)
        return source.code_hash.__wrapped__()

    return compute


@pytest.fixture
def copy(tmp_path):
    """Copy the package without what a build or an editor adds."""
    built = shutil.ignore_patterns("__pycache__", "*.so")
    return Path(shutil.copytree(PACKAGE, tmp_path / "cloudrc", ignore=built))


def test_built_files_and_those_of_an_editor_do_not_count(copy, hash_of):
    assert hash_of(copy) == source.code_hash()
    (copy / "__pycache__").mkdir()
    (copy / "__pycache__/source.cpython-313.pyc").write_bytes(b"built")
    (copy / "robots/native/step-1-cc.so").write_bytes(b"built")
    (copy / ".#assembly.py").symlink_to("somebody@host.1")
    (copy / "_chart").mkdir()
    (copy / "_chart/values.yaml").write_text("a: wheel has the chart\n")
    (copy / "cli/run.py").write_text("# no flight imports the commands\n")
    assert hash_of(copy) == source.code_hash()


def test_each_kind_of_source_counts(copy, hash_of):
    seen = {source.code_hash()}
    names = "pelican/rotors.py", "native/step.c", "native/step.h", "x2/robot.xml", "x2/robot.yaml"
    for name in names:
        with (copy / "robots" / name).open("a") as file:
            file.write("\n")
        assert hash_of(copy) not in seen
        seen.add(hash_of(copy))


def test_a_flight_runs_nothing_from_the_folders_that_do_not_count():
    program = (
        "from cloudrc.config.load import load_experiment\n"
        "from cloudrc.runs.flight import fly_point\n"
        "row = fly_point(load_experiment('steps', ['mission.steps.count=1']))\n"
        "assert row['verdict'] == 'success', row"
    )
    flown = {name.split(".")[1] for name in loaded(program) if name.startswith("cloudrc.")}
    assert {"world", "cloud", "metrics"} <= flown
    assert source.NOT_FLOWN.isdisjoint(flown)
