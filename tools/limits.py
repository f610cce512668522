# SPDX-License-Identifier: Apache-2.0

"""Fly `follow` in pods whose processor time is limited; write the table of docs/results.md.

It needs a cluster with the images (make kind-load), and takes 20 minutes. It takes the release
`limits` in the current namespace, and deletes it.

    python -m tools.limits          KUBECONFIG names the cluster
"""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from cloudrc.cluster.client import chart_folder
from cloudrc.config.robot import find_robot
from tools.markdown import table
from tools.radio import write
from tools.results import cloudrc

PAGE = Path(__file__).resolve().parents[1] / "docs" / "results.md"
TOOL, RELEASE = "tools.limits", "limits"
CPUS = "100m", "150m", "200m", "250m"
"""Limits of world's container [cores]."""
RATES = 5, 10, 15
"""Pictures per second [Hz]."""
DURATION_S = 20
"""Duration of a flight [s]."""


def robot_with(rate: int, folder: Path) -> Path:
    """Write a robot that is x2 but for the number of its pictures per second; return its folder."""
    made = folder / f"x2-{rate}"
    made.mkdir(exist_ok=True)
    for file in find_robot("x2").model.parent.glob("robot.*"):
        text = file.read_text("utf-8")
        (made / file.name).write_text(text.replace("{name: front", f"{{fps: {rate}, name: front"))
    return made


def limit(cpu: str) -> None:
    """Give world's container at most `cpu` cores."""
    words = ["upgrade", "--install", RELEASE, chart_folder(), "--reset-then-reuse-values"]
    values = f"link.mode=relay,world.resources.limits.cpu={cpu}"
    subprocess.run(["helm", *words, "--set-string", values], check=True, capture_output=True)


def fly(rate: int, folder: Path, out: Path) -> dict[str, Any]:
    """Fly with this number of pictures per second [Hz]; return the numbers of the report.

    A flight that is not in real time has a report, too.
    """
    robot, duration = f"world.robot={robot_with(rate, folder)}", f"duration_s={DURATION_S}"
    settings = ["--set", robot, "--set", f"mission.follow.{duration}", "--report", "none"]
    words = ["run", "follow", "--mode", "cluster", "--release", RELEASE, *settings]
    cloudrc(*words, "--out", out)
    found = json.loads((out / "report.json").read_text("utf-8"))["numbers"]
    return {name: entry["value"] for name, entry in found.items()}


def cell(numbers: dict[str, Any], rate: int) -> str:
    """Tell of a flight: the pictures that were late, of all that were due, and its pace."""
    due = rate * DURATION_S
    late, factor = numbers["frames_late"], numbers["real_time_factor"]
    return f"{late / due:.0%}, {factor:.3f}"


def rows(folder: Path) -> Iterator[tuple[str, ...]]:
    """Fly with all limits and rates; yield the table's row for each limit."""
    for cpu in CPUS:
        limit(cpu)
        yield cpu, *(cell(fly(rate, folder, folder / f"{cpu}-{rate}"), rate) for rate in RATES)


def main() -> None:
    """Fly, and write the table."""
    columns = " | ".join(["limit of the world pod [cores]", *(f"{rate} Hz" for rate in RATES)])
    try:
        with TemporaryDirectory() as folder:
            write(PAGE, table(columns, rows(Path(folder))), TOOL)
    finally:
        subprocess.run(["helm", "uninstall", RELEASE], check=False)


if __name__ == "__main__":
    main()
