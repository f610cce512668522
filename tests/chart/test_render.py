# SPDX-License-Identifier: Apache-2.0

"""Every values file renders to valid Kubernetes objects, as with helm, and to those in rendered/.

`rendered/default.yaml` has the objects of the default values. The other files have what other
values change: a line with - is one of the default, a line with + comes instead or in addition. To
renew a file, delete it and run the tests.
"""

import functools
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml

import cloudrc
from tests.chart.conftest import (
    CHART,
    METADATA,
    OPERATOR,
    VALUES,
    a_namespace,
    containers,
    nothing,
    pod_specs,
    render,
    values_of,
)
from tests.conftest import nightly
from tests.support.snapshots import compare

kubernetes_validate = pytest.importorskip("kubernetes_validate", reason="comes with the extra dev")

RENDERED = Path(__file__).parent / "rendered"
OLDEST = re.match(r">=(\d+\.\d+)\.0-0$", METADATA["kubeVersion"])[1]
NEWEST = ".".join(kubernetes_validate.latest_version().split(".")[:2])
CASES = {
    **values_of(Path(__file__).with_name("cases.yaml")),
    **{path.stem.replace("values", "").strip("-"): values_of(path) for path in VALUES[1:]},
}
"""Name of a file in rendered/ -> values."""


class Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data):
        return True


def shown(values):
    """Render what does not change by itself: without Secrets, hashes, versions and long texts."""
    objects = render(values, lookup=a_namespace() if "netem" in str(values) else nothing)
    text = json.dumps([thing for thing in objects if thing["kind"] != "Secret"])
    text = re.sub(r'("checksum/\w+": )"\w+"', r'\1"HASH"', text)
    text = re.sub(r"-mission-[0-9a-f]{8}", "-mission-HASH", text)
    text = text.replace(f"cloudrc-{METADATA['version']}", "cloudrc-VERSION")
    text = text.replace(cloudrc.__version__, "VERSION")
    found = json.loads(text)
    for thing in found:
        if thing["kind"] in ("ConfigMap", "PrometheusRule"):
            own = thing["metadata"]["name"].endswith("experiment")
            thing["data"] = thing.get("data") if own else [*thing.get("data", ())]
            thing.pop("spec", None)
    return found


def leaves(part, path=""):
    """Yield a line for each value; an item of a list is named by its name, if it has one."""
    if isinstance(part, dict) and part:
        for key, value in part.items():
            yield from leaves(value, f"{path}.{key}")
    elif isinstance(part, list) and part:
        for number, each in enumerate(part):
            names = each if isinstance(each, dict) else {"name": ""}
            place = names.get("mountPath", names.get("name", number))
            yield from leaves(each, f"{path}[{place}]")
    else:
        yield f"{path}: {json.dumps(part)}"


def lines(objects):
    found = []
    for thing in objects:
        name = re.sub("^(demo-cloudrc|robot)-", "", thing["metadata"]["name"])
        for line in leaves({k: v for k, v in thing.items() if k not in ("kind", "apiVersion")}):
            found.append(f"{thing['kind']} {name}{line}".replace(".spec.template.spec.", "."))
    return found


@functools.cache
def default_lines():
    return lines(shown({}))


def test_the_default_values_give_these_objects():
    assert METADATA["appVersion"] == cloudrc.__version__
    text = yaml.dump_all(
        shown({}), None, Dumper, sort_keys=False, width=100, default_flow_style=None
    )
    compare(RENDERED / "default.yaml", text)


@pytest.mark.parametrize("name", CASES)
def test_other_values_change_these_lines(name):
    found, default = lines(shown(CASES[name])), default_lines()
    gone = [f"- {line}" for line in default if line not in {*found}]
    new = [f"+ {line}" for line in found if line not in {*default}]
    compare(
        RENDERED / f"{name}.diff",
        "".join(f"{line}\n" for line in sorted((*gone, *new), key=_place)),
    )


def _place(line):
    return line[2:].partition(": ")[0], line


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
    for name in ("link-set-role", "sweep-job"):
        for thing in yaml.safe_load_all((CHART / "examples" / f"{name}.yaml").read_text()):
            kubernetes_validate.validate(thing, version, strict=True)


def helm(*arguments):
    if shutil.which("helm") is None:
        pytest.skip("no helm here")
    return subprocess.run(["helm", *arguments], capture_output=True, text=True)


NUMBERS = """\
world: {recordingSizeLimit: 2147483648}
cloud: {recordingSizeLimit: 1500000000}
recordings: {storage: 10737418240, keepMissions: 1000000, keepDays: 2000000}
mission: {enabled: true, ttlSecondsAfterFinished: 3000000}
experiment: {seed: 2147483648, link: {uplink: {rate_kbit: 1000000}}}
teleop: {journal: {size: 104857600}}
"""


def test_numbers_of_a_values_file_arrive_as_numbers(tmp_path):
    """Helm reads 2147483648 in a file as 2.147483648e+09; --set would hide it."""
    path = tmp_path / "values.yaml"
    path.write_text(NUMBERS)
    done = helm("template", "x", str(CHART), "--kube-version", OLDEST, "--values", str(path))
    assert re.findall(r".*\de\+\d.*", done.stdout) == []
    wanted = ("--record-max=2147483648", "--record-max=1500000000", "--keep=1000000")
    wanted += ("--keep-days=2000000", "ttlSecondsAfterFinished: 3000000", "storage: 10737418240")
    wanted += ("seed: 2147483648", "rate_kbit: 1000000", "storage: 104857600")
    assert [each for each in wanted if each not in done.stdout] == []


@pytest.mark.parametrize("path", [*VALUES[:2], *nightly(*VALUES[2:])], ids=lambda path: path.stem)
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


def _comparable(objects):
    """Ignore the hash in the Job's name: Helm writes 1.0 as 1, which changes the hash."""
    found = {}
    for original in objects:
        thing = json.loads(re.sub(r"-mission-[0-9a-f]{8}", "-mission", json.dumps(original)))
        if thing["kind"] == "ConfigMap":
            thing["data"] = {name: yaml.safe_load(text) for name, text in thing["data"].items()}
        found[thing["kind"], thing["metadata"]["name"]] = thing
    return found
