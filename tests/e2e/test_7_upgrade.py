"""A release of an earlier chart, packed, is upgraded and rolled back in flight."""

import subprocess

import pytest

from tests.conftest import nightly_rows
from tests.e2e.conftest import (
    CHART,
    INTERRUPTED,
    LONG,
    ROOT,
    eventually,
    fly,
    helm,
    in_release,
    job_end,
    job_log,
    read,
    until_ready,
)

OLD = "cloudrc-old"
"""The release that is upgraded."""
AUDIT = "--audit=/var/lib/cloudrc-journal/audit.jsonl"
"""An argument of earlier charts, for the images of that time."""


@pytest.fixture
def chart(before, tmp_path):
    """The earlier chart; another argument takes the place of one that today's images lack."""
    packed = ROOT / "tests" / "fixtures" / "charts" / f"cloudrc-{before}.tgz"
    subprocess.run(["tar", "-xzf", packed, "-C", tmp_path], check=True)
    cloud = tmp_path / "cloudrc" / "templates" / "cloud" / "deployment.yaml"
    cloud.write_text(cloud.read_text().replace(AUDIT, '"--metrics=[::]:9101"'))
    yield tmp_path / "cloudrc"
    helm("uninstall", OLD, "--wait")


def ends():
    """Return component -> identity of its pod, which changes if it restarts."""
    release = f"app.kubernetes.io/instance={OLD},app.kubernetes.io/component in (world,cloud)"
    found = [p for p in read("pods", f"--selector={release}")["items"]]
    alive = [p["metadata"] for p in found if "deletionTimestamp" not in p["metadata"]]
    return {p["labels"]["app.kubernetes.io/component"]: p["uid"] for p in alive}


def changed(before, *command):
    """Run a command of helm; return the components whose pods are replaced by it."""
    helm(*command)
    until_ready(OLD)
    return {component for component, uid in ends().items() if before[component] != uid}


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("before", "keeps", "restarts"),
    [
        ("before-fleet", "--reuse-values", set()),
        *nightly_rows(("before-light", "--reset-then-reuse-values", set())),
        *nightly_rows(("before-right", "--reuse-values", {"cloud"})),
    ],
)
def test_a_mission_goes_on_while_its_release_is_upgraded_and_rolled_back(
    installed, chart, before, keeps, restarts
):
    helm("install", OLD, str(chart), "--set=link.mode=relay")
    until_ready(OLD)
    fly("old", LONG, 300.0, OLD)
    eventually(lambda: "waypoint 1 of 2 reached" in job_log("old"), "the mission flies", 90.0)
    assert changed(ends(), "upgrade", OLD, str(CHART), keeps) == restarts
    assert changed(ends(), "rollback", OLD, "1") == restarts
    said = in_release("mission", "cancel", release=OLD)
    assert "waypoint 2 of 2" in said, "it was under way"
    end, _ = job_end("old", OLD)
    assert end.exit_code == INTERRUPTED, end


@pytest.mark.full
@pytest.mark.parametrize("before", ["before-guests"])
def test_the_earliest_chart_is_upgraded_with_both_pods(installed, chart, before):
    helm("install", OLD, str(chart), "--set=link.mode=relay,world.epochs.a=b")
    until_ready(OLD)
    assert changed(ends(), "upgrade", OLD, str(CHART), "--reuse-values") == {"world", "cloud"}
    assert "world.epochs" in helm("get", "notes", OLD)
