# SPDX-License-Identifier: Apache-2.0

"""A release is upgraded and rolled back in flight; one of an earlier chart restarts."""

import re
import subprocess

import pytest

from tests.conftest import nightly, nightly_rows
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
PROCESS = re.compile("^( +)- (world|cloud|teleop)$", re.MULTILINE)
"""A command of earlier charts, for the images of that time: the first argument of a container."""


@pytest.fixture
def chart(before, tmp_path):
    """The earlier chart, with the commands and arguments that today's images know."""
    if before == "now":
        yield CHART
        helm("uninstall", OLD, "--wait")
        return
    packed = ROOT / "tests" / "fixtures" / "charts" / f"cloudrc-{before}.tgz"
    subprocess.run(["tar", "-xzf", packed, "-C", tmp_path], check=True)
    for end in ("world", "cloud"):
        file = tmp_path / "cloudrc" / "templates" / end / "deployment.yaml"
        text = file.read_text().replace(AUDIT, '"--metrics=[::]:9101"')
        file.write_text(PROCESS.sub(r"\1- process\n\1- \2", text))
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
    ("before", "keeps"),
    [("now", "--reset-then-reuse-values"), *nightly_rows(("now", "--reuse-values"))],
)
def test_a_mission_goes_on_while_its_release_is_upgraded_and_rolled_back(
    installed, chart, before, keeps
):
    helm("install", OLD, str(chart), "--set=link.mode=relay")
    until_ready(OLD)
    fly("old", LONG, 300.0, OLD)
    eventually(lambda: "waypoint 1 of 2 reached" in job_log("old"), "the mission flies", 90.0)
    assert changed(ends(), "upgrade", OLD, str(CHART), keeps) == set()
    assert changed(ends(), "rollback", OLD, "1") == set()
    said = in_release("mission", "cancel", release=OLD)
    assert "waypoint 2 of 2" in said, "it was under way"
    end, _ = job_end("old", OLD)
    assert end.exit_code == INTERRUPTED, end


@pytest.mark.parametrize(
    "before", ["before-fleet", *nightly("before-light", "before-right", "before-guests")]
)
def test_an_earlier_chart_is_upgraded_with_both_pods(installed, chart, before):
    gone = ",world.epochs.a=b" * (before == "before-guests")
    helm("install", OLD, str(chart), f"--set=link.mode=relay{gone}")
    until_ready(OLD)
    assert changed(ends(), "upgrade", OLD, str(CHART), "--reuse-values") == {"world", "cloud"}
    assert bool(gone) == ("world.epochs" in helm("get", "notes", OLD))
