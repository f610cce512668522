# SPDX-License-Identifier: Apache-2.0

"""The doctor: every problem has a fix; only what the mode needs blocks it."""

import os
import signal
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from cloudrc.base import requirements
from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.doors.cli import doctor as work
from cloudrc.doors.cli.doctor import Check
from cloudrc.link.exec import namespace
from cloudrc.physics.sim import egl
from tests.support.camera import needs_renderer

PLAIN = SimpleNamespace(camera=False)
GOOD = Check("python", "ok", "3.12.1", "", ("local", "virtual"))
NO_HELM = Check("helm", "missing", "not in PATH", "https://helm.sh", ("cluster",))
NO_PHYSICS = Check("physics", "missing", "aborted", "install mujoco", ("local", "virtual"))


@pytest.mark.parametrize(
    ("mode", "found", "code"),
    [
        ("local", [GOOD, NO_HELM], 0),
        ("cluster", [GOOD, NO_HELM], 3),
        ("virtual", [NO_PHYSICS], 3),
    ],
)
def test_only_a_needed_check_gives_exit_code_3(mode, found, code, monkeypatch, call, as_json):
    monkeypatch.setattr(work, "all_checks", lambda *given: iter(found))
    text = call(f"doctor --mode {mode}", code=code).out
    assert text.splitlines()[-1].startswith(f"Mode {mode} can")
    assert all(check.fix in text for check in found)
    assert as_json(f"doctor --mode {mode}", code=code)["ready"] is (code == 0)


def test_every_problem_says_how_to_fix_it(monkeypatch):
    monkeypatch.setitem(requirements.EXTRAS, "world", ("no_such_module",))
    monkeypatch.setattr(work, "step_once", lambda: sys.exit("no physics"))
    checks = {check.name: check for check in work.all_checks("local", PLAIN)}
    for check in checks.values():
        assert check.state == "ok" or check.fix, check.name
        assert len(f"  missing  {check.name}  {check.found}") < 160
    assert checks["extra world"].fix == "pip install 'cloudrc[world]'"
    assert checks["extra world"].modes == ("local", "virtual")
    assert (checks["physics"].state, checks["physics"].found) == ("missing", "no physics")
    with pytest.raises(MissingPrerequisiteError, match=r"mode virtual needs no_such_module.*world"):
        requirements.require("mode virtual", ["world", "record"])


def test_a_library_that_kills_its_process_is_told(monkeypatch):
    monkeypatch.setattr(work, "step_once", lambda: os.kill(os.getpid(), signal.SIGKILL))
    checks = {check.name: check for check in work.all_checks("local", PLAIN)}
    assert (checks["physics"].state, checks["physics"].found) == ("missing", "exit code -9")


@needs_renderer
@pytest.mark.parametrize("camera", [True, False])
def test_a_machine_that_renders_is_told(camera):
    checks = {
        check.name: check for check in work.all_checks("local", SimpleNamespace(camera=camera))
    }
    assert checks["camera"].state == "ok"
    assert (" ms " in checks["camera"].found) is camera


def test_a_machine_without_egl_is_told(monkeypatch):
    monkeypatch.setattr(egl, "LIBRARY", "no-such-library.so")
    checks = {check.name: check for check in work.all_checks("local", PLAIN)}
    assert checks["camera"].state == "warn"
    assert checks["camera"].fix.startswith("run: apt-get")


def test_a_machine_without_namespaces_is_told_with_the_remedy_of_the_error(monkeypatch):
    def fail():
        raise MissingPrerequisiteError("no namespace; none", fix="allow it; or not")

    monkeypatch.setattr(namespace, "enter", fail)
    check = {each.name: each for each in work.all_checks("local", PLAIN)}["link exec"]
    assert check[1:4] == ("warn", "no namespace; none", "allow it; or not")


def test_the_extras_are_those_of_pyproject():
    project = tomllib.loads((Path(__file__).parents[3] / "pyproject.toml").read_text())["project"]
    declared = project["optional-dependencies"]
    for extra, modules in requirements.EXTRAS.items():
        packages = {requirements.PACKAGES.get(module, module) for module in modules}
        assert all(name in " ".join(declared[extra]) for name in packages), extra
    assert set(requirements.EXTRAS) | {"sim", "all", "dev", "deep"} == set(declared)
    assert declared["sim"] == [f"cloudrc[{','.join(requirements.MODES['virtual'])}]"]
