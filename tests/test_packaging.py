"""The package: dependencies, version, licence and the files of the wheel."""

import re
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest

import cloudrc

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SHIPPED = {".py", ".yaml", ".xml", ".typed", ".csv", ".html", ".css", ".js", ".mplstyle"}


def test_base_dependencies_are_those_of_a_pod():
    names = {re.split(r"[<>=\[; ]", line)[0] for line in PROJECT["dependencies"]}
    assert names == {"numpy", "pyyaml", "pydantic", "cryptography", "prometheus-client", "rich"}


def test_cloudrc_is_a_plugin_of_kubectl_and_names_one_version():
    assert PROJECT["scripts"]["kubectl-cloudrc"] == PROJECT["scripts"]["cloudrc"]
    assert f"\nversion: {cloudrc.__version__}\n" in (ROOT / "CITATION.cff").read_text()


def test_the_wheel_holds_every_file_of_the_package(tmp_path):
    pytest.importorskip("hatchling", reason="the build backend comes with the extra dev")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        packed = {name for name in archive.namelist() if name.startswith("cloudrc/")}
    source = {
        path.relative_to(ROOT).as_posix()
        for path in (ROOT / "cloudrc").rglob("*")
        if path.suffix in SHIPPED and "__pycache__" not in path.parts
    }
    assert source <= packed
    assert {"cloudrc/_chart/Chart.yaml", "cloudrc/_chart/templates/NOTES.txt"} <= packed
