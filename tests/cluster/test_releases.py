# SPDX-License-Identifier: Apache-2.0

"""Which release a command means: the named one, or the only one of the namespace; never a guess."""

from contextlib import contextmanager
from unittest.mock import Mock

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.cluster.client import ClusterError
from cloudrc.cluster.jobs import run_job
from cloudrc.cluster.releases import only_release
from tests.cluster.conftest import MISSION, deployment, labels


def put_files(api, experiment, link, name="cloudrc", namespace="demo"):
    """Put the ConfigMaps of a release: the files of its experiment and its link."""
    files = {"experiment": {"experiment.yaml": experiment}, "link": {"profile.yaml": link}}
    for kind, data in files.items():
        about = {**labels(kind), "app.kubernetes.io/instance": name}
        metadata = {"name": f"{namespace}-{name}-{kind}", "namespace": namespace, "labels": about}
        api.put("configmaps", {"metadata": metadata, "data": data})


def release_in(api, name, namespace="demo", *, ready=True, experiment="{}", link="profile: null"):
    """Put the objects of a release that `cloudrc list releases` reads."""
    for component in ("world", "cloud"):
        available = int(ready or component == "world")
        body = deployment(component, availableReplicas=available)
        body["metadata"]["labels"]["app.kubernetes.io/instance"] = name
        body["metadata"] |= {"name": f"{namespace}-{name}-{component}", "namespace": namespace}
        api.put("deployments", body)
    put_files(api, experiment, link, name, namespace)


def test_the_only_release_is_used_whatever_its_name_and_of_several_none(api, release):
    with pytest.raises(ClusterError, match=r"^no release in namespace 'demo'; see all: helm"):
        only_release(release)
    release_in(api, "alpha")
    assert only_release(release).name == "alpha"
    release_in(api, "cloudrc")
    with pytest.raises(BadInputError, match=r"'demo': alpha, cloudrc; name one: --release NAME"):
        only_release(release)


JITTER = "{uplink: {delay_ms: 45, jitter_ms: 25}, downlink: {delay_ms: 45, jitter_ms: 25}}"


def test_the_releases_of_all_namespaces_are_listed(api, call, as_json, monkeypatch):
    release_in(api, "b", "lab", ready=False, experiment="world: {robot: heavy}", link=JITTER)
    release_in(api, "a", link="uplink: {delay_ms: 40, loss: 0.1}")
    flies = {"id": "m3", "state": "flying", "reached": [{}, {}], "waypoints": 7}
    missions = {"a": flies, "b": None}

    @contextmanager
    def answers(release):
        yield Mock(get=lambda path: {"mission": missions[release.name]})

    monkeypatch.setattr("cloudrc.cluster.fleet.release_api", answers)
    rows = as_json("list releases")["releases"]
    assert [list(row.values()) for row in rows] == [
        ["a", "demo", "pelican", "40 ms, loss / 0 ms", "ready", "m3 flying 2/7"],
        ["b", "lab", "heavy", "45\u00b125 ms", "cloud not ready", "-"],
    ]
    assert [line.split()[0] for line in call("list releases -n lab").out.splitlines()] == [
        "NAME", "b",
    ]  # fmt: skip


def test_a_fleet_is_one_line_with_its_robots_and_what_its_job_does(fleet, release, as_json):
    api = fleet(6)
    put_files(api, "cell: {rate_kbit: 500}", "profile: null")
    job = run_job(release, MISSION)
    api.get("jobs", job)["status"] = {"active": 4, "succeeded": 1, "failed": 1}
    api.get("statefulsets", "cloudrc-world")["status"]["availableReplicas"] = 5
    (row,) = as_json("list releases")["releases"]
    assert row["robot"] == "6 pelican"
    assert row["link"] == "45\u00b125 ms, cell 500"
    assert row["state"] == "world 5/6 not ready"
    assert row["mission"] == f"{job} flying 4, done 1, failed 1"
