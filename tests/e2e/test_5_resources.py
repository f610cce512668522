"""Limits as emulation: they constrain, it shows, and a run not in real time says so."""

import json
from collections.abc import Callable
from typing import Any

import pytest
import yaml

from tests.e2e.conftest import CHART, EXAMPLES, NAME, NAMESPACE, cloudrc, helm, metrics, pace, value

SHORT = ["--set", "mission.waypoints.0.dwell_s=6"]
"""Over `hover`: long enough to be throttled, short enough for a suite."""
PATIENCE = 480.0
"""For a world with 15m of a CPU, which takes minutes to start where Python takes 2 s [s]."""
VISIBLE = 10.0
"""Times as long as unconstrained a part has to be throttled."""
Constrained = Callable[..., tuple[int, dict[str, Any]]]


@pytest.fixture
def constrained(installed, values, tmp_path):
    """Fly under an example's limits: exit code and report."""

    def fly(name, *words):
        file = EXAMPLES / f"values-{name}.yaml"
        helm("upgrade", NAME, str(CHART), f"--values={values}", f"--values={file}", *words)
        # 'cloudrc run' keeps these values, lays its experiment over them and waits.
        line = ["run", "hover", *SHORT, "--mode", "cluster", "-n", NAMESPACE, "--release", NAME]
        done = cloudrc(*line, "--out", str(tmp_path / name), timeout=PATIENCE)
        assert (tmp_path / name / "report.json").is_file(), done.stdout + done.stderr
        return done.returncode, json.loads((tmp_path / name / "report.json").read_text())

    yield fly
    helm("upgrade", NAME, str(CHART), f"--values={values}")


def throttled(component):
    return value(metrics(component), "cloudrc_cpu_throttled_seconds_total")


def scaled(name, component):
    """Give a part the share of what it takes on this machine that the example names.

    The examples are chosen where Python is quick. With 40m of the 110m that it takes on a slow
    machine the controller is in HOLD too often for a waypoint to be kept for 6 s.
    """
    example = yaml.safe_load((EXAMPLES / f"values-{name}.yaml").read_text())
    cpu = example[component]["resources"]["limits"]["cpu"]
    millicores = round(float(cpu.removesuffix("m")) * pace())
    kinds = ("limits", "requests")
    return [f"--set={component}.resources.{kind}.cpu={millicores}m" for kind in kinds]


@pytest.mark.parametrize(
    ("name", "component"),
    [("constrained-drone", "world"), pytest.param("loaded-cloud", "cloud", marks=pytest.mark.full)],
)
def test_a_constrained_part_is_throttled_yet_keeps_real_time(constrained, note, name, component):
    plain = throttled(component)
    code, report = constrained(name, *scaled(name, component))
    assert (code, report["verdict"]) == (0, "success"), report
    numbers = {key: entry["value"] for key, entry in report["numbers"].items()}
    stopped = throttled(component)
    note(
        f"{name}: throttled {stopped:.2f} s (unconstrained: {plain:.2f} s),"
        f" lateness p99 {numbers[f'{component}_lateness_p99'] * 1e3:.1f} ms,"
        f" prediction error {numbers['prediction_error_rms'] * 1e3:.1f} mm,"
        f" real-time factor {numbers['real_time_factor']:.3f}"
    )
    assert stopped > VISIBLE * plain
    assert stopped > 0
    assert numbers["real_time_factor"] >= 0.95


@pytest.mark.full
def test_a_world_that_cannot_keep_up_says_invalid(constrained):
    code, report = constrained("invalid")
    assert (code, report["verdict"]) == (6, "invalid")
