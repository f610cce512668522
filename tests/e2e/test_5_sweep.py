"""A sweep in pods gives the table of a sweep on this machine, even if pods are lost."""

import csv
import subprocess
import sys

import yaml

from tests.e2e.conftest import NAMESPACE, ROOT, eventually, kubectl, read

SWEEP = {
    "experiment": "steps",
    "set": {"link.profile": "paper-p2", "mission.steps.count": 5},
    "grid": {"cloud.predictor": ["last_sample", "constant_velocity"]},
    "seeds": 16,
}
SHARDS = 8


def running():
    selector = "--selector=app.kubernetes.io/component=sweep"
    found = read("pods", selector, "--field-selector=status.phase=Running")["items"]
    return [f"pod/{each['metadata']['name']}" for each in found]


def table(folder):
    """Read the table of a sweep, without the names of the machine codes: compilers differ."""
    with (folder / "table.csv").open(newline="") as file:
        rows = [*csv.DictReader(file)]
    for row in rows:
        del row["physics_steps"]
    return rows


def test_two_of_eight_pods_are_killed_and_the_table_is_the_same(cluster, tmp_path):
    file = tmp_path / "sweep.yaml"
    file.write_text(yaml.safe_dump(SWEEP))
    words = [sys.executable, "-m", "cloudrc", "sweep", "run", str(file)]
    pods = ["--on=kubernetes", f"--shards={SHARDS}", "--cpu=50m", "-n", NAMESPACE]
    flight = subprocess.Popen([*words, f"--out={tmp_path}/pods", *pods], cwd=ROOT)
    try:
        eventually(lambda: len(running()) == SHARDS, "all pods fly", timeout=90.0)
        kubectl("delete", "--grace-period=0", "--force", *running()[:2])
        assert flight.wait(180) == 0
    finally:
        flight.kill()
    subprocess.run([*words, f"--out={tmp_path}/here"], cwd=ROOT, check=True)
    in_pods, here = table(tmp_path / "pods"), table(tmp_path / "here")
    assert in_pods == here
    assert read("jobs", "--selector=app.kubernetes.io/component=sweep")["items"] == []
