"""Every values file renders to valid Kubernetes objects, as with helm."""

import functools
import json
import re
import shutil
import subprocess

import pytest
import yaml

from tests.chart.conftest import (
    CHART,
    METADATA,
    OPERATOR,
    VALUES,
    containers,
    each_file,
    pod_specs,
    render,
    values_of,
)

kubernetes_validate = pytest.importorskip("kubernetes_validate", reason="comes with the extra dev")

OLDEST = re.match(r">=(\d+\.\d+)\.0-0 ", METADATA["kubeVersion"])[1]
NAMES_IN_LAB = ("lab-cloudrc", "lab-robot-b")
NEWEST = ".".join(kubernetes_validate.latest_version().split(".")[:2])


@pytest.mark.parametrize("version", sorted({OLDEST, NEWEST}))
def test_the_objects_and_the_examples_are_valid(version, monkeypatch):
    utils = kubernetes_validate.utils  # the library reads two megabytes for each object
    monkeypatch.setattr(utils, "schema_contents", functools.cache(utils.schema_contents))
    for path in VALUES:
        objects = [o for o in render(values_of(path)) if o["apiVersion"] != OPERATOR]
        assert len(objects) > 10
        for thing in objects:
            kubernetes_validate.validate(thing, version, strict=True)
        for pod in pod_specs(objects).values():  # server-side apply refuses duplicates
            parts = containers(pod).values()
            named = [volume["name"] for volume in pod.get("volumes", ())]
            for names in (named, *([p["name"] for p in part.get("ports", ())] for part in parts)):
                assert len(names) == len(set(names))
                assert max(map(len, names), default=0) <= 15
    for name in ("link-set-role", "mission-job", "mission-paper", "sweep-job"):
        for thing in yaml.safe_load_all((CHART / "examples" / f"{name}.yaml").read_text()):
            kubernetes_validate.validate(thing, version, strict=True)


def helm(*arguments):
    if shutil.which("helm") is None:
        pytest.skip("no helm here")
    return subprocess.run(["helm", *arguments], capture_output=True, text=True)


@each_file
def test_helm_renders_the_same_objects(path):
    flags = ("--kube-version", OLDEST, "--values", str(path))
    done = helm("template", "demo", str(CHART), "--namespace", "lab", *flags)
    assert (done.returncode, done.stderr) == (0, "")
    by_helm = _comparable(thing for thing in yaml.safe_load_all(done.stdout) if thing)
    here = _comparable(render(values_of(path)))
    assert by_helm.keys() == here.keys()
    for key, thing in here.items():
        assert key[0] == "Secret" or by_helm[key] == thing
    done = helm("lint", "--strict", *flags, str(CHART))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "WARNING" not in done.stdout


def test_a_larger_chart_switches_its_parts_by_conditions(tmp_path):
    def render_lab(*flags):
        done = helm("template", "lab", str(tmp_path), "--kube-version", OLDEST, *flags)
        assert (done.returncode, done.stderr) == (0, "")
        found = (thing for thing in yaml.safe_load_all(done.stdout) if thing)
        return {x["metadata"]["name"] for x in found if x["kind"] == "Deployment"}

    shutil.copytree(CHART, tmp_path / "charts" / "cloudrc")
    part = {"name": "cloudrc", "version": METADATA["version"], "condition": "cloudrc.enabled"}
    other = {**part, "alias": "robot_B", "condition": "robot_B.enabled", "tags": ["more"]}
    lab = {"apiVersion": "v2", "name": "lab", "version": "1.0.0", "dependencies": [part, other]}
    (tmp_path / "Chart.yaml").write_text(yaml.safe_dump(lab))
    (tmp_path / "values.yaml").write_text("global: {imageRegistry: registry.example.org}")
    one, two = ({f"{name}-{end}" for end in ("world", "cloud")} for name in NAMES_IN_LAB)
    assert render_lab() == one | two
    assert render_lab("--set", "cloudrc.enabled=true,robot_B.enabled=false") == one
    assert render_lab("--set", "cloudrc.enabled=false,robot_B.enabled=true") == two
    assert render_lab("--set", "cloudrc.enabled=false,tags.more=false") == set()


def test_helm_keeps_a_large_seed():
    """Helm writes numbers above a million as powers of ten, which are no integers."""
    flags = ("--kube-version", OLDEST, "--set-json", 'experiment={"seed": 4503599627370495}')
    shown = ("--show-only", "templates/shared/experiment.yaml")
    assert "seed: 4503599627370495\n" in helm("template", "demo", str(CHART), *shown, *flags).stdout


def _comparable(objects):
    """Ignore the hash in the Job's name: Helm writes 1.0 as 1, which changes the hash."""
    found = {}
    for original in objects:
        thing = json.loads(re.sub(r"-mission-[0-9a-f]{8}", "-mission", json.dumps(original)))
        if thing["kind"] == "ConfigMap":
            thing["data"] = {name: yaml.safe_load(text) for name, text in thing["data"].items()}
        found[thing["kind"], thing["metadata"]["name"]] = thing
    return found
