"""A sweep in pods gives the table of a sweep on this machine, even if pods and client are lost."""

import csv
import json
import signal
import subprocess
import sys

import pytest
import yaml

from tests.e2e.conftest import EXAMPLES, NAMESPACE, ROOT, apply, command, eventually, kubectl, read

RUN = [sys.executable, "-m", "cloudrc", "sweep"]
SWEEP = "--selector=app.kubernetes.io/component=sweep"
FLOWN = (0, 1)
"""Exit codes of a sweep whose flights have all ended: 1 if one has failed its mission."""
CLAIM = {
    "apiVersion": "v1",
    "kind": "PersistentVolumeClaim",
    "metadata": {"name": "rows"},
    "spec": {
        "accessModes": ["ReadWriteOnce"],
        "resources": {"requests": {"storage": "100Mi"}},
    },
}


@pytest.fixture
def sweep(tmp_path):
    """Return a function that writes the file of a sweep with so many flights."""

    def write(flights, steps=5):
        file = tmp_path / "sweep.yaml"
        document = {
            "experiment": "steps",
            "set": {"link.profile": "paper-p2", "mission.steps.count": steps},
            "grid": {"cloud.predictor": ["last_sample", "./mine.py"]},
            "seeds": flights // 2,
        }
        file.write_text(yaml.safe_dump(document))
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
    apply({"apiVersion": "v1", "kind": "Pod", "metadata": {"name": "rows"}, "spec": spec})
    ended = "--for=jsonpath={.status.phase}=Succeeded"
    kubectl("wait", "pod/rows", ended, "--timeout=100s")
    return kubectl("logs", "rows")


@pytest.mark.parametrize(
    ("flights", "shards", "kills", "steps"),
    [(8, 2, 1, 10), pytest.param(200, 8, 4, 5, marks=pytest.mark.full)],
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


TEXT, COUNT = {"type": "string"}, {"type": "integer"}
AMOUNT = {"x-kubernetes-int-or-string": True}
ANY = {"type": "object", "x-kubernetes-preserve-unknown-fields": True}
QUOTA = {"name": TEXT, "nominalQuota": AMOUNT, "borrowingLimit": AMOUNT, "lendingLimit": AMOUNT}
GROUP = {"coveredResources": [TEXT], "flavors": [{"name": TEXT, "resources": [QUOTA]}]}
JOBS = {"name": TEXT, "replicas": COUNT, "groupName": TEXT, "template": ANY}
KINDS = {
    "kueue.x-k8s.io/v1beta2": {
        "ResourceFlavor": ("Cluster", {"nodeLabels": ANY, "topologyName": TEXT}),
        "ClusterQueue": (
            "Cluster",
            {"cohortName": TEXT, "namespaceSelector": ANY, "resourceGroups": [GROUP]},
        ),
        "LocalQueue": ("Namespaced", {"clusterQueue": TEXT, "stopPolicy": TEXT}),
    },
    "jobset.x-k8s.io/v1alpha2": {
        "JobSet": (
            "Namespaced",
            {
                "failurePolicy": {"maxRestarts": COUNT},
                "replicatedJobs": [JOBS],
                "suspend": {"type": "boolean"},
            },
        ),
    },
}
"""API version -> kind -> its scope, and fields of its spec: those of the examples and some beside
them. A field that is not here is refused. Their names are those of the API references of Kueue
(v1beta2) and JobSet (v1alpha2)."""


def schema(form):
    """Return the schema of a value: of a mapping's fields, of a list's items, or `form` itself."""
    if isinstance(form, list):
        return {"type": "array", "items": schema(form[0])}
    if "type" in form or form is AMOUNT:
        return form
    fields = {name: schema(each) for name, each in form.items()}
    return {"type": "object", "properties": fields}


def definitions():
    """Yield the definition of each kind that the examples need."""
    for api, kinds in KINDS.items():
        group, version = api.split("/")
        for kind, (scope, spec) in kinds.items():
            plural = f"{kind.lower()}s"
            one = {"name": version, "served": True, "storage": True}
            names = {"kind": kind, "plural": plural, "singular": kind.lower()}
            note = {"api-approved.kubernetes.io": "unapproved, of a test"}
            versions = [{**one, "schema": {"openAPIV3Schema": schema({"spec": spec})}}]
            yield {
                "apiVersion": "apiextensions.k8s.io/v1",
                "kind": "CustomResourceDefinition",
                "metadata": {"name": f"{plural}.{group}", "annotations": note},
                "spec": {"group": group, "names": names, "scope": scope, "versions": versions},
            }


def test_the_examples_for_kueue_and_jobset_are_taken(cluster):
    """By the API server, with definitions of this test; the Job of the JobSet by its own rules."""
    made = yaml.safe_dump_all(definitions())
    command("kubectl", "create", "--filename=-", given=made)
    try:
        names = [f"crd/{each['metadata']['name']}" for each in definitions()]
        command("kubectl", "wait", "--for=condition=Established", "--timeout=60s", *names)
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
        command("kubectl", "delete", "--ignore-not-found", "--filename=-", given=made)
