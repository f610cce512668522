"""End-to-end tests name missing programs; the command and its kubectl plug-in are installed."""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def test_e2e_says_which_programs_are_missing(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pytest", "-m", "e2e", "tests/e2e/test_7_end.py", "-q"]
    environ = {**os.environ, "PATH": str(tmp_path), "KUBECONFIG": str(tmp_path / "none")}
    done = subprocess.run(command, cwd=ROOT, env=environ, capture_output=True, text=True)
    assert done.returncode == 3
    for tool in ("docker", "kind", "helm", "kubectl"):
        assert f"{tool}: https://" in done.stdout + done.stderr


def test_cloudrc_is_a_plugin_of_kubectl() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    assert scripts["kubectl-cloudrc"] == scripts["cloudrc"]
