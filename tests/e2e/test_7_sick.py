# SPDX-License-Identifier: Apache-2.0

"""`cloudrc doctor --release` and `mission status` name what a release suffers from."""

import base64
import json
import re
from contextlib import contextmanager

import pytest

from cloudrc.base.errors import CloudrcError
from cloudrc.cluster.client import connect
from cloudrc.cluster.flight import wait_ready
from cloudrc.cluster.incidents import find_causes
from tests.conftest import nightly_rows
from tests.e2e.conftest import CHART, apply, cloudrc, command, eventually, helm, kubectl

WARD = "cloudrc-e2e-sick"
SICK = "sick"
IN_WARD = f"--namespace={WARD}"
TIME_TO_FALL_ILL = 300.0
"""Time limit for pods to start and for the cause to show [s]; a quiet machine needs 20 s."""
QUOTA = """
apiVersion: v1
kind: ResourceQuota
metadata: {name: tiny}
spec: {hard: {requests.cpu: 10m}}
"""
TCP_ALONE = """
apiVersion: networking.k8s.io/v1
kind: NetworkPolicy
metadata: {name: tcp-alone}
spec: {podSelector: {}, policyTypes: [Ingress], ingress: [{ports: [{protocol: TCP}]}]}
"""
OTHER_KEY = f"""
apiVersion: v1
kind: Secret
metadata: {{name: other}}
data: {{key: {base64.b64encode(bytes(range(32))).decode()}}}
"""
MEMORY = [f"--set=cloud.resources.{kind}.memory=24Mi" for kind in ("requests", "limits")]
LITTLE_CPU = {"name": "cloud", "resources": {"requests": {"cpu": "40m"}, "limits": {"cpu": "40m"}}}


def release():
    return connect(None, WARD, SICK)


def install(*settings):
    helm("upgrade", "--install", SICK, str(CHART), IN_WARD, "--set=link.mode=relay", *settings)


def patch(kind, name, spec, *words):
    """Patch the spec of a pod."""
    text = json.dumps({"spec": spec})
    kubectl(IN_WARD, "patch", kind, name, "--type=strategic", f"--patch={text}", *words)


@contextmanager
def values(*settings):
    install(*settings)
    yield


@contextmanager
def objects(text, *settings):
    apply(text, WARD)
    install(*settings)
    yield
    kubectl(IN_WARD, "delete", "--filename=-", given=text)


@contextmanager
def another_key():
    apply(OTHER_KEY, WARD)
    install()
    volume = {"name": "secret", "secret": {"secretName": "other"}}
    patch("deployment", f"{SICK}-cloudrc-world", {"template": {"spec": {"volumes": [volume]}}})
    yield


@contextmanager
def throttled():
    install()
    wait_ready(release(), timeout=TIME_TO_FALL_ILL)
    (pod,) = kubectl(
        IN_WARD, "get", "pods", "--selector=app.kubernetes.io/component=cloud", "--output=name"
    ).split()
    patch(*pod.split("/"), {"containers": [LITTLE_CPU]}, "--subresource=resize")
    yield


@contextmanager
def without_dns():
    install()
    wait_ready(release(), timeout=TIME_TO_FALL_ILL)
    scale = ("kubectl", "--namespace=kube-system", "scale", "deployment", "coredns")
    command(*scale, "--replicas=0")
    try:
        yield
    finally:
        command(*scale, "--replicas=2")


SITUATIONS = [
    ("image", values("--set=image.tag=nowhere"), "image cloudrc/.*:nowhere .*make kind-load"),
    (
        "claim",
        values("--set=recordings.existingClaim=nothere"),
        '"nothere" not found.*recordings.existingClaim',
    ),
    ("memory", values(*MEMORY), "more memory than its limit.*cloud.resources.limits.memory="),
    ("key", another_key(), "another key.*secret.existingSecret="),
    *nightly_rows(
        ("quota", objects(QUOTA), "exceeded quota: tiny.*ask for a larger quota"),
        (
            "UDP",
            objects(TCP_ALONE, "--set=networkPolicy.enabled=false"),
            "UDP from the cloud pod does not arrive.*get networkpolicies",
        ),
        ("CPU", throttled(), "stopped by its CPU limit.*cloud.resources.limits.cpu="),
        ("DNS", without_dns(), "cannot resolve the name of the other end.*k8s-app=kube-dns"),
    ),
]


@pytest.fixture
def ward(cluster):
    """A namespace of its own, because a quota or a policy is for all pods of a namespace."""
    apply(f"apiVersion: v1\nkind: Namespace\nmetadata: {{name: {WARD}}}")
    yield
    helm("uninstall", SICK, IN_WARD, "--wait")


@pytest.fixture(scope="module", autouse=True)
def closed_ward():
    yield
    kubectl("delete", "namespace", WARD, "--ignore-not-found", "--wait=false")


@pytest.mark.parametrize(("name", "situation", "words"), SITUATIONS)
def test_what_a_release_suffers_from_is_named_with_its_remedy(ward, note, name, situation, words):
    def is_told():
        try:
            return [each for each in find_causes(release()) if re.search(words, str(each))]
        except CloudrcError:  # a pod has just ended
            return []

    flags = ("--release", SICK, "-n", WARD)
    with situation:
        eventually(is_told, words, TIME_TO_FALL_ILL, every=1.0)
        doctor = cloudrc("doctor", *flags)
        status = cloudrc("mission", "status", *flags)
    told = doctor.stdout.replace("\n           -> ", "; ")
    assert re.search(words, told), told
    assert doctor.returncode == (0 if name == "CPU" else 3)
    assert re.search(words, status.stderr), status.stdout + status.stderr
    note(f"sick by {name}: {next(line for line in told.splitlines() if re.search(words, line))}")
