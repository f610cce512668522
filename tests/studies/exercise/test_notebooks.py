# SPDX-License-Identifier: Apache-2.0

"""The notebooks run from the first cell to the last, and open where their badges say."""

import json
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
NOTEBOOKS = sorted(ROOT.glob("docs/notebooks/*.ipynb"))


def source(path, kind):
    cells = json.loads(path.read_text())["cells"]
    return ["".join(cell["source"]) for cell in cells if cell["cell_type"] == kind]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_badges_of_a_notebook_open_it(path):
    first, name = source(path, "markdown")[0], path.relative_to(ROOT).as_posix()
    if "badge" in first:
        assert f"/blob/main/{name})" in first
        assert f"labpath={name.replace('/', '%2F')})" in first


def test_codespaces_and_binder_install_extras_that_there_are():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    codespace = json.loads((ROOT / ".devcontainer/devcontainer.json").read_text())
    build = ROOT / "binder/postBuild"
    assert build.stat().st_mode & 0o100, "Binder runs a program"
    for command in (codespace["postCreateCommand"], build.read_text()):
        assert command.partition("[")[2].partition("]")[0] in project["optional-dependencies"]


@pytest.mark.full
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs(path, tmp_path, monkeypatch):
    nbformat, nbclient = (pytest.importorskip(name) for name in ("nbformat", "nbclient"))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:/usr/bin:/bin")
    notebook = nbformat.read(path, as_version=4)
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": tmp_path}}
    )
    client.execute()
