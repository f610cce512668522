"""MuJoCo is imported without OpenGL; if it is missing, the error says so."""

import os
import subprocess
import sys

import pytest

from cloudrc.errors import MissingPrerequisiteError
from cloudrc.world.scene import import_mujoco

FLIGHT = """
from cloudrc.world.simulator import Simulator
simulator = Simulator("pelican", "pipes")
for _ in range(100):
    simulator.step((600.0,) * 4)
assert simulator.readings.position[2] > 0.1
"""


def test_it_flies_without_the_requested_gl(tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", FLIGHT],
        env={**os.environ, "MUJOCO_GL": "egl", "PYTHONPATH": os.pathsep.join(sys.path)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("wanted", [None, "disable", "egl"])
def test_the_variable_is_restored(monkeypatch, wanted):
    if wanted is None:
        monkeypatch.delenv("MUJOCO_GL", raising=False)
    else:
        monkeypatch.setenv("MUJOCO_GL", wanted)
    import_mujoco()
    assert os.environ.get("MUJOCO_GL") == wanted


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(MissingPrerequisiteError, match=r"cloudrc\[world\]") as error:
        import_mujoco()
    assert error.value.exit_code == 3
