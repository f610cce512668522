# SPDX-License-Identifier: Apache-2.0

"""A sweep in pods gives the table of a sweep on this machine, even if pods and client are lost."""

import csv
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from tests.conftest import nightly_rows
from tests.e2e.conftest import EXAMPLES, NAMESPACE, ROOT, apply, command, eventually, kubectl, read

RUN = [sys.executable, "-m", "cloudrc", "sweep"]
SWEEP = "--selector=app.kubernetes.io/component=sweep"
FLOWN = (0, 1)
"""Exit codes of a sweep whose flights have all ended: 1 if one has failed its mission."""
CLAIM = """
apiVersion: v1
kind: PersistentVolumeClaim
metadata: {name: rows}
spec: {accessModes: [ReadWriteOnce], resources: {requests: {storage: 100Mi}}}
"""


@pytest.fixture
def sweep(tmp_path):
    """Return a function that writes the file of a sweep with so many flights."""

    def write(flights, steps=5):
        file = tmp_path / "sweep.yaml"
        file.write_text(f"""
experiment: steps
set: {{link.profile: paper-p2, mission.steps.count: {steps}}}
grid: {{cloud.predictor: [last_sample, ./mine.py]}}
seeds: {flights // 2}
""")
        mine = "from cloudrc.cloud.predictors.constant_velocity import build as build\n"
        (tmp_path / "mine.py").write_text(mine)
        return file

    return write


def running():
    found = read("pods", SWEEP, "--field-selector=status.phase=Running")["items"]
    return [f"pod/{each['metadata']['name']}" for each in found]


@pytest.fixture
def start():
    """Return a function that starts a sweep in pods, and returns its process once they run."""
    clients = []

    def run(file, out, shards, *flags):
        words = ["--on=kubernetes", f"--shards={shards}", "--cpu=20m", "-n", NAMESPACE, *flags]
        command = [*RUN, "run", str(file), f"--out={out}", *words]
        clients.append(subprocess.Popen(command, cwd=ROOT))
        eventually(lambda: len(running()) == shards, "all pods fly", timeout=90.0)
        return clients[-1]

    yield run
    for each in clients:
        each.kill()


def here(file, out):
    """Fly a sweep on this machine; return its table."""
    done = subprocess.run([*RUN, "run", str(file), f"--out={out}"], cwd=ROOT)
    assert done.returncode in FLOWN
    return table(out)


def table(folder):
    """Read the table of a sweep, without the names of the machine codes: compilers differ."""
    with (folder / "table.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    for row in rows:
        del row["physics_steps"]
    return rows


def keys(lines):
    return [json.loads(line)["key"] for line in lines.splitlines()]


def rows_of_claim():
    """Return the lines of all files of rows in the claim, by a pod that prints them."""
    (job,) = (
        d for d in yaml.safe_load_all((EXAMPLES / "sweep-job.yaml").read_text()) if "spec" in d
    )
    spec = job["spec"]["template"]["spec"]
    (container,) = spec["containers"]
    container["command"] = ["sh", "-c", "cat /rows/*/rows*.jsonl"]
    container["volumeMounts"] = [{"name": "rows", "mountPath": "/rows"}]
    container["resources"]["requests"]["cpu"] = "50m"
    spec["volumes"] = [{"name": "rows", "persistentVolumeClaim": {"claimName": "rows"}}]
    pod = {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "rows"}, "spec": spec}
    apply(yaml.safe_dump(pod))
    ended = "--for=jsonpath={.status.phase}=Succeeded"
    kubectl("wait", "pod/rows", ended, "--timeout=100s")
    return kubectl("logs", "rows")


@pytest.mark.parametrize(
    ("flights", "shards", "kills", "steps"),
    [(8, 2, 1, 10), *nightly_rows((200, 8, 4, 5))],
)
def test_every_row_is_flown_once_though_pods_and_client_are_killed(
    cluster, sweep, start, tmp_path, flights, shards, kills, steps
):
    apply(CLAIM)
    file, out = sweep(flights, steps), tmp_path / "pods"
    try:
        client = start(file, out, shards, "--claim=rows")
        seen = out / "rows.jsonl"
        eventually(lambda: seen.exists() and len(keys(seen.read_text())) > 1, "rows", 120.0)
        client.send_signal(signal.SIGKILL)
        kubectl("delete", "--grace-period=1", *running()[:kills])
        attached = subprocess.run([*RUN, "attach", str(out)], cwd=ROOT, timeout=600)
        assert attached.returncode in FLOWN
        assert table(out) == here(file, tmp_path / "here")
        kept = keys(rows_of_claim())
        assert len(kept) == len({*kept}) == len(keys(seen.read_text())) == flights
    finally:
        kubectl("delete", "pod/rows", "--ignore-not-found")
        kubectl("delete", "pvc/rows", "--wait=false")
    assert read("jobs", SWEEP)["items"] == []


@pytest.mark.full
def test_without_a_claim_the_rows_of_lost_pods_are_flown_again(cluster, sweep, start, tmp_path):
    file = sweep(32)
    client = start(file, tmp_path / "pods", 8)
    kubectl("delete", "--grace-period=0", "--force", *running()[:2])
    assert client.wait(180) in FLOWN
    assert table(tmp_path / "pods") == here(file, tmp_path / "here")


def test_the_examples_for_kueue_and_jobset_are_taken(cluster):
    """By the API server, with definitions of this test; the Job of the JobSet by its own rules."""
    kinds = f"--filename={Path(__file__).with_name('kinds.yaml')}"
    command("kubectl", "create", kinds)
    try:
        command("kubectl", "wait", "--for=condition=Established", "--timeout=60s", kinds)
        take = ["create", "--dry-run=server", "--validate=strict", "--filename=-"]
        for name, field in (("kueue-queue", "nominalQuota"), ("sweep-jobset", "maxRestarts")):
            text = (EXAMPLES / f"{name}.yaml").read_text()
            kubectl(*take, given=text)
            with pytest.raises(AssertionError, match="unknown field"):
                kubectl(*take, given=text.replace(field, f"{field}s"))
        _, jobset = yaml.safe_load_all((EXAMPLES / "sweep-jobset.yaml").read_text())
        for each in jobset["spec"]["replicatedJobs"]:
            job = {"apiVersion": "batch/v1", "kind": "Job", "metadata": {"name": each["name"]}}
            text = yaml.safe_dump({**job, **each["template"]})
            kubectl(*take, given=text)
    finally:
        command("kubectl", "delete", "--ignore-not-found", kinds)
