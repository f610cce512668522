# SPDX-License-Identifier: Apache-2.0

"""CPU limits throttle containers, metrics show this, and a run slower than real time is invalid."""

import json

import pytest
import yaml

from tests.conftest import nightly_rows
from tests.e2e.conftest import (
    CHART,
    EXAMPLES,
    NAME,
    NAMESPACE,
    cloudrc,
    helm,
    metrics,
    pace,
    until_ready,
    value,
)

pytestmark = pytest.mark.real_time
SHORT = ["--set", "mission.waypoints.0.dwell_s=6"]
"""Setting of `hover` that makes the flight long enough to be throttled."""
RUN_LIMIT = 480.0
"""Time limit of a run [s]; with 0.015 cores, world takes minutes to start."""
RATIO_MIN = 10.0
"""Smallest ratio of the throttled time with the limit to that without the limit [1]."""


@pytest.fixture
def constrained(installed, values, tmp_path):
    """A function that flies under the limits of an example, and returns exit code and report."""

    def fly(name, *words):
        file = EXAMPLES / f"values-{name}.yaml"
        helm("upgrade", NAME, str(CHART), f"--values={values}", f"--values={file}", *words)
        # `cloudrc run` keeps these values and changes only the experiment.
        line = ["run", "hover", *SHORT, "--mode", "cluster", "-n", NAMESPACE, "--release", NAME]
        done = cloudrc(*line, "--out", str(tmp_path / name), timeout=RUN_LIMIT)
        assert (tmp_path / name / "report.json").is_file(), done.stdout + done.stderr
        return done.returncode, json.loads((tmp_path / name / "report.json").read_text())

    until_ready()
    yield fly
    helm("upgrade", NAME, str(CHART), f"--values={values}")


def throttled(component):
    return value(metrics(component), "cloudrc_cpu_throttled_seconds_total")


def scaled(name, component):
    """Scale the CPU limit of an example by the pace of this machine.

    The examples fit a machine with fast Python. A slow machine may need 0.11 cores for cloud; with
    0.04 cores the robot is in HOLD so often that it does not stay at a waypoint for 6 s.
    """
    example = yaml.safe_load((EXAMPLES / f"values-{name}.yaml").read_text())
    cpu = example[component]["resources"]["limits"]["cpu"]
    millicores = round(float(cpu.removesuffix("m")) * pace())
    kinds = ("limits", "requests")
    return [f"--set={component}.resources.{kind}.cpu={millicores}m" for kind in kinds]


@pytest.mark.parametrize(
    ("name", "component"),
    [("constrained-drone", "world"), *nightly_rows(("loaded-cloud", "cloud"))],
)
@pytest.mark.fault(
    16,
    "cloud-throttled",
    injects="a CPU limit of the pod stops world or cloud again and again",
    expects="the mission succeeds in real time",
    figures="real-time factor at least .95",
)
def test_a_constrained_part_is_throttled_yet_keeps_real_time(constrained, note, name, component):
    plain = throttled(component)
    code, report = constrained(name, *scaled(name, component))
    assert (code, report["verdict"]) == (0, "success"), report
    numbers = {key: entry["value"] for key, entry in report["numbers"].items()}
    stopped = throttled(component)
    note(f"{name}: throttled {stopped:.2f} s (unconstrained: {plain:.2f} s)")
    assert stopped > RATIO_MIN * plain
    assert stopped > 0
    assert numbers["real_time_factor"] >= 0.95


@pytest.mark.full
@pytest.mark.fault(
    18,
    "world-overloaded",
    injects="world gets less CPU than real time needs",
    expects="the run says that it is invalid",
    figures="exit code 6",
)
def test_a_world_that_cannot_keep_up_says_invalid(constrained):
    code, report = constrained("invalid")
    assert (code, report["verdict"]) == (6, "invalid")
