"""`helm test` passes, and uninstalling leaves nothing but the Secret."""

from __future__ import annotations

from kube import NAME, eventually, helm, pods, read

KINDS = "deployment,service,configmap,networkpolicy,secret,serviceaccount,pvc,job"


def test_helm_test_flies_and_passes(installed: None) -> None:
    said = helm("test", NAME, "--timeout=180s", timeout=200.0)
    assert "Phase:          Succeeded" in said


def test_uninstalling_leaves_only_the_secret(installed: None) -> None:
    """Jobs are the user's own: those go with their time to live."""
    helm("uninstall", NAME, "--wait")
    eventually(lambda: not pods("world") and not pods("cloud"), "both pods are gone", 60.0)
    found = read(KINDS, f"--selector=app.kubernetes.io/instance={NAME}")["items"]
    left = [
        one
        for one in found
        if one["metadata"]["labels"].get("app.kubernetes.io/managed-by") == "Helm"
    ]
    assert [one["kind"] for one in left] == ["Secret"]
