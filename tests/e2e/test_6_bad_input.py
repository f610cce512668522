"""Each problem of a cluster ends in one sentence and the right exit code."""

import subprocess

import pytest

from tests.e2e.conftest import CHART, NAMESPACE, apply, cloudrc, command

ELSEWHERE = f"{NAMESPACE}-bad"


@pytest.fixture(scope="module")
def namespace(cluster):
    """A namespace without restrictions, for releases that do not work."""
    apply({"apiVersion": "v1", "kind": "Namespace", "metadata": {"name": ELSEWHERE}})
    yield ELSEWHERE
    command("kubectl", "delete", "namespace", ELSEWHERE, "--wait=false")


def refused(release, *settings):
    """Install with helm, then use cloudrc; return its exit code and error message."""
    command("helm", "install", release, CHART, f"-n={ELSEWHERE}", *settings)
    line = ["run", "hover", "--mode", "cluster", "-n", ELSEWHERE, "--release", release]
    done = cloudrc(*line, "--timeout", "60")
    (said,) = [each for each in done.stderr.splitlines() if each.startswith("cloudrc: error:")]
    assert "Traceback" not in done.stderr
    command("helm", "uninstall", release, f"-n={ELSEWHERE}")
    return done.returncode, said


def test_an_image_that_is_not_loaded_is_named(namespace):
    code, line = refused("no-image", "--set=image.tag=0.0.0-missing")
    assert code == 5
    assert "cloudrc/world:0.0.0-missing" in line or "cloudrc/cloud:0.0.0-missing" in line
    assert "make kind-load" in line


@pytest.mark.full
def test_netem_without_kernel_support_is_refused_with_advice(namespace):
    if has_netem():
        pytest.skip("this kernel has sch_netem")
    code, line = refused("no-netem", "--set=link.mode=netem")
    assert code == 5
    assert "sch_netem" in line
    assert "relay" in line


def has_netem():
    nodes = command("kubectl", "get", "nodes", "--output=jsonpath={.items[0].metadata.name}")
    probe = "ip link add probe0 type dummy && tc qdisc add dev probe0 root netem delay 1ms"
    done = subprocess.run(["docker", "exec", nodes, "sh", "-c", probe], capture_output=True)
    subprocess.run(["docker", "exec", nodes, "ip", "link", "delete", "probe0"], capture_output=True)
    return done.returncode == 0
