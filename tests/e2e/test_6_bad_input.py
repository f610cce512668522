"""Each problem of a cluster ends in one sentence and the right exit code."""

import os
import subprocess
import sys

import pytest
import yaml

from tests.e2e.conftest import CHART, NAMESPACE, ROOT, apply, cloudrc, command

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


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["--set=secret.existingSecret=mine"], "no Secret 'mine'"),
        (["--set=link.mdoe=relay"], "mdoe"),
        (["--set=link.profile=no-such"], "no-such"),
    ],
    ids=["missing Secret", "unknown value", "unknown profile"],
)
def test_helm_itself_refuses_what_cannot_work(namespace, settings, words):
    with pytest.raises(AssertionError, match=words):
        command("helm", "install", "refused", CHART, f"-n={ELSEWHERE}", *settings)


def test_without_permission_one_sentence_says_so(namespace, tmp_path):
    environ = {**os.environ, "KUBECONFIG": str(powerless(tmp_path))}
    words = ["mission", "list", "-n", ELSEWHERE, "--release", "bad"]
    done = subprocess.run(
        [sys.executable, "-m", "cloudrc", *words],
        env=environ,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 5
    assert "forbidden" in done.stderr
    assert "kubectl auth can-i" in done.stderr


def powerless(folder):
    """Write the kubeconfig of a service account without rights."""
    account = {"name": "powerless", "namespace": ELSEWHERE}
    apply({"apiVersion": "v1", "kind": "ServiceAccount", "metadata": account})
    token = command("kubectl", "create", "token", "powerless", f"-n={ELSEWHERE}").strip()
    config = yaml.safe_load(command("kubectl", "config", "view", "--raw", "--minify"))
    config["users"][0]["user"] = {"token": token}
    path = folder / "kubeconfig"
    path.write_text(yaml.safe_dump(config))
    return path
