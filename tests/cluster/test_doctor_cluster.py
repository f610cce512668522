# SPDX-License-Identifier: Apache-2.0

"""`cloudrc doctor --mode cluster` says "can run" if and only if `cloudrc run` can."""

import shutil

import pytest

from cloudrc.cluster import client
from cloudrc.cluster.client import ClusterError, Release
from cloudrc.doors.cli import doctor as checks
from tests.cluster.conftest import CONFIG_PLACE, kubeconfig


@pytest.fixture(autouse=True)
def programs(monkeypatch):
    """Make only these programs available; skip the slow checks that are not about a cluster."""
    monkeypatch.setattr(checks, "step_once", lambda: print(checks.WORKS, "C (here)", sep="\n"))
    found = {"helm", "kubectl"}
    monkeypatch.setattr(shutil, "which", lambda name: f"/nowhere/{name}" if name in found else None)
    return found


@pytest.fixture
def doctor(as_json):
    """Return a function that runs the doctor; it returns the checks by their names."""

    def run(code, *more):
        report = as_json("doctor --mode cluster", *more, code=code)
        assert report["ready"] is (code == 0)
        return {check["name"]: check for check in report["checks"]}

    return run


def test_a_cluster_elsewhere_does_not_need_kind(api, programs, doctor):
    found = doctor(0)
    assert found["cluster"]["found"] == "the API server answers"
    assert found["kind"]["state"] == "warn"
    assert "to make a cluster here" in found["kind"]["fix"]
    assert doctor(3, "--context", "x")["kubeconfig"]["state"] == "missing"
    programs.remove("helm")
    assert doctor(3)["helm"]["state"] == "missing"


@pytest.mark.parametrize("fix", ["call; or write", ""])
def test_what_to_do_is_told_by_the_error_and_not_by_its_words(api, doctor, monkeypatch, fix):
    def fail(*given, **wanted):
        raise ClusterError("this; and that", fix=fix)

    monkeypatch.setattr(Release, "request", fail)
    check = doctor(3)["cluster"]
    assert (check["found"], check["fix"]) == ("this; and that", fix or checks.MAKE_CLUSTER)


def test_a_cluster_that_cannot_be_reached_blocks_the_mode(tmp_path, doctor, monkeypatch):
    monkeypatch.setattr(CONFIG_PLACE, str(tmp_path / "config"))
    monkeypatch.setattr(client, "RETRIES", {"total": 0})
    (tmp_path / "config").touch()
    assert "no cluster is configured" in doctor(3)["kubeconfig"]["found"]
    (tmp_path / "config").write_text(kubeconfig("http://127.0.0.1:9"))
    check = doctor(3)["cluster"]
    assert "does not answer" in check["found"]
    assert "kubectl cluster-info" in check["fix"]
