"""The package: dependencies, version, licence and the files of the wheel."""

import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import cloudrc
from cloudrc.world.native.library import built_file, compilers

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SHIPPED = {".py", ".c", ".yaml", ".xml", ".typed", ".csv", ".html", ".css", ".js", ".mplstyle"}


def test_cloudrc_is_a_plugin_of_kubectl_and_names_one_version():
    assert PROJECT["scripts"]["kubectl-cloudrc"] == PROJECT["scripts"]["cloudrc"]
    assert f"\nversion: {cloudrc.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def build_wheel(folder):
    """Build the wheel in `folder`; return its name and the names of the package's files in it."""
    pytest.importorskip("hatchling", reason="the build backend comes with the extra dev")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = folder.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        return wheel.name, {name for name in archive.namelist() if name.startswith("cloudrc/")}


def test_the_wheel_holds_every_file_of_the_package(tmp_path, monkeypatch):
    monkeypatch.delenv("CLOUDRC_NATIVE", raising=False)
    name, packed = build_wheel(tmp_path)
    assert name.endswith("-py3-none-any.whl")
    source = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "cloudrc").rglob("*")
        if path.suffix in SHIPPED and "__pycache__" not in path.parts
    }
    assert source <= packed
    assert {"cloudrc/_chart/Chart.yaml", "cloudrc/_chart/templates/NOTES.txt"} <= packed


@pytest.mark.skipif(not list(compilers()), reason="no compiler here")
def test_a_platform_wheel_holds_the_machine_code(tmp_path, monkeypatch):
    monkeypatch.setenv("CLOUDRC_NATIVE", "1")
    name, packed = build_wheel(tmp_path)
    assert "-py3-none-any" not in name
    assert f"cloudrc/world/native/{built_file().name}" in packed
    assert not built_file().exists()
