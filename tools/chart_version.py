# SPDX-License-Identifier: Apache-2.0

"""Refuse a change of the chart without a higher version of it; CI runs this.

python -m tools.chart_version [SINCE]    the commit to compare with (default: HEAD^)
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[1]
CHART = "charts/cloudrc"


def version_of(text: str) -> tuple[int, ...]:
    """Return the version in the text of a Chart.yaml."""
    return tuple(int(part) for part in str(yaml.safe_load(text)["version"]).split("."))


def is_refused(root: Path, since: str) -> bool:
    """Say whether the chart of a repository has changed since a commit, and not its version."""

    def git(*words: str) -> str:
        command = ["git", "-C", str(root), *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    if not git("diff", "--name-only", since, "--", CHART):
        return False
    before = version_of(git("show", f"{since}:{CHART}/Chart.yaml"))
    return version_of((root / CHART / "Chart.yaml").read_text()) <= before


if __name__ == "__main__":
    commit = sys.argv[1] if len(sys.argv) > 1 else "HEAD^"
    if is_refused(ROOT, commit):
        sys.exit(
            f"{CHART} has changed since {commit}: raise `version` in its Chart.yaml, and tell in "
            "UPGRADING.md what an upgrade restarts"
        )
