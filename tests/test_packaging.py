"""The package: what pyproject.toml, the Makefile and the wheel promise to those who install it."""

from __future__ import annotations

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


def test_the_base_is_what_a_pod_needs_and_no_more() -> None:
    names = {re.split(r"[<>=\[; ]", line)[0] for line in PROJECT["dependencies"]}
    assert names == {"numpy", "pyyaml", "pydantic", "cryptography", "prometheus-client"}


def test_the_extras_are_those_of_the_issue() -> None:
    extras = {"world", "report", "record", "kube", "api", "dev", "all"}
    assert set(PROJECT["optional-dependencies"]) == extras


def test_everything_says_the_same_version() -> None:
    citation = (ROOT / "CITATION.cff").read_text()
    assert f"\nversion: {cloudrc.__version__}\n" in citation
    assert PROJECT["dynamic"] == ["version"]


def test_the_licence_is_whole() -> None:
    text = (ROOT / "LICENSE").read_text()
    assert "Apache License" in text
    assert "END OF TERMS AND CONDITIONS" in text
    assert len(text.splitlines()) > 195


def test_the_wheel_holds_every_file_of_the_package(tmp_path: Path) -> None:
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


def test_make_prints_every_target() -> None:
    done = subprocess.run(["make", "-C", ROOT], check=True, capture_output=True, text=True)
    targets = re.findall(r"^\s+make ([\w-]+)", done.stdout, re.MULTILINE)
    phony = re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert phony is not None
    assert targets == phony[1].split()


def test_demo_installs_no_tool_of_ours(tmp_path: Path) -> None:
    """`make -n` says what it would do: the environment, then the flight in real time."""
    command = ["make", "-n", "-C", str(ROOT), "demo", f"VENV={tmp_path}/venv"]
    plan = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert "--editable '.[all]'" in plan
    assert "[dev]" not in plan
    assert "cloudrc run paper --mode local" in plan


def test_the_continuous_integration_calls_what_a_user_calls() -> None:
    script = (ROOT / ".ci" / "run").read_text()
    assert script.startswith("#!/usr/bin/env bash\n")
    assert "set -euo pipefail" in script
    called = re.findall(r"^(?:\S+netem-vm )?(?:make|once_more) ([a-z0-9-]+)", script, re.MULTILINE)
    steps = "lint types demo process test coverage faults e2e test-netem figures"
    assert called == steps.split()
    assert (ROOT / ".ci" / "run").stat().st_mode & 0o111
    subprocess.run(["bash", "-n", str(ROOT / ".ci" / "run")], check=True)


@pytest.mark.parametrize(
    "path",
    [ROOT / "CONTRIBUTING.md", *sorted(ROOT.glob(".github/workflows/*"))],
    ids=lambda p: p.name,
)
def test_the_targets_that_are_named_exist(path: Path) -> None:
    targets = set(re.findall(r"^([a-z0-9-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    lines = re.findall(
        r"^\W*(?:run: |sudo )*make ((?:[a-z0-9-]+ ?)+)", path.read_text(), re.MULTILINE
    )
    named = {target for line in lines for target in line.split()}
    assert named
    assert named <= targets


def test_a_night_runs_every_mark_but_that_of_netem() -> None:
    """It begins without the numbers of older commits, and ends with what needs a cluster."""
    plan = subprocess.run(
        ["make", "-n", "-C", str(ROOT), "nightly"], check=True, capture_output=True, text=True
    ).stdout.splitlines()
    words = [re.sub(r"\S*/bin/", "", line).strip() for line in plan]
    assert words.index("rm -rf build/figures") < words.index("pytest -m process")
    assert [w for w in words if w.startswith("pytest")][-1].startswith("pytest -m e2e ")
