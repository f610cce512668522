"""Limits as emulation: they constrain, it shows, and a run not in real time says so."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
import yaml

from tests.e2e.conftest import CHART, EXAMPLES, NAME, NAMESPACE, cloudrc, helm, metrics, pace, value

PLACE = ["-n", NAMESPACE, "--release", NAME]
SHORT = ["--set", "mission.waypoints.0.dwell_s=6"]
"""Over `hover`: long enough to be throttled, short enough for a suite."""
PATIENCE = 480.0
"""For a world with 15m of a CPU, which takes minutes to start where Python takes 2 s [s]."""
VISIBLE = 10.0
"""Times as long as unconstrained a part has to be throttled."""


@pytest.fixture
def with_values(installed: None, values: Path) -> Iterator[Callable[..., None]]:
    def upgrade(name: str, *words: str) -> None:
        file = EXAMPLES / f"values-{name}.yaml"
        helm("upgrade", NAME, str(CHART), f"--values={values}", f"--values={file}", *words)
        # Not waited for: 'cloudrc run' keeps these values, lays its experiment over them and waits.

    yield upgrade
    helm("upgrade", NAME, str(CHART), f"--values={values}")


def flown(folder: Path) -> tuple[int, dict]:
    words = ("run", "hover", *SHORT, "--mode", "cluster", *PLACE, "--out", str(folder))
    done = cloudrc(*words, timeout=PATIENCE)
    assert (folder / "report.json").is_file(), done.stdout + done.stderr
    return done.returncode, json.loads((folder / "report.json").read_text())


def throttled(component: str) -> float:
    return value(metrics(component), "cloudrc_cpu_throttled_seconds_total")


def scaled(name: str, component: str) -> list[str]:
    """Give a part the share of what it takes on this machine that the example names.

    The examples are chosen where Python is quick. With 40m of the 110m that it takes on a slow
    machine the controller is in HOLD too often for a waypoint to be kept for 6 s.
    """
    example = yaml.safe_load((EXAMPLES / f"values-{name}.yaml").read_text())
    cpu = example[component]["resources"]["limits"]["cpu"]
    millicores = round(float(cpu.removesuffix("m")) * pace())
    return [
        f"--set={component}.resources.{kind}.cpu={millicores}m" for kind in ("limits", "requests")
    ]


@pytest.fixture(scope="module")
def plain(installed: None) -> dict[str, float]:
    """How long the parts of the release as it comes were throttled in all their life [s]."""
    return {component: throttled(component) for component in ("world", "cloud")}


@pytest.mark.parametrize(
    ("name", "component"), [("constrained-drone", "world"), ("loaded-cloud", "cloud")]
)
def test_a_constrained_part_is_throttled_yet_keeps_real_time(
    plain: dict[str, float],
    with_values: Callable[..., None],
    tmp_path: Path,
    note: Callable[[str], None],
    name: str,
    component: str,
) -> None:
    with_values(name, *scaled(name, component))
    code, report = flown(tmp_path / name)
    assert (code, report["verdict"]) == (0, "success"), report
    numbers = {key: entry["value"] for key, entry in report["numbers"].items()}
    stopped = throttled(component)
    note(
        f"{name}: throttled {stopped:.2f} s (unconstrained: {plain[component]:.2f} s),"
        f" lateness p99 {numbers[f'{component}_lateness_p99'] * 1e3:.1f} ms,"
        f" prediction error {numbers['prediction_error_rms'] * 1e3:.1f} mm,"
        f" real-time factor {numbers['real_time_factor']:.3f}"
    )
    assert stopped > VISIBLE * plain[component]
    assert stopped > 0
    assert numbers["real_time_factor"] >= 0.95


@pytest.mark.full
def test_a_world_that_cannot_keep_up_says_invalid(
    with_values: Callable[..., None], tmp_path: Path
) -> None:
    with_values("invalid")
    code, report = flown(tmp_path / "invalid")
    assert (code, report["verdict"]) == (6, "invalid")
