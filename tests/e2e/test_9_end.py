"""Uninstalling leaves only Secrets."""

from tests.e2e.conftest import EXAMPLES, NAME, eventually, helm, kubectl, read

KINDS = "deployment,service,configmap,networkpolicy,secret,serviceaccount,pvc,job,pod"


def test_uninstalling_leaves_only_the_secrets(installed):
    """The Jobs of `cloudrc mission run` are deleted, too; a Job that a user applied is not."""
    kubectl("delete", f"--filename={EXAMPLES / 'mission-paper.yaml'}", "--ignore-not-found")
    helm("uninstall", NAME, "--wait")

    def left():
        found = read(KINDS, f"--selector=app.kubernetes.io/instance={NAME}")["items"]
        return sorted(f"{one['kind']} {one['metadata']['name']}" for one in found)

    secrets = [f"Secret {NAME}-tokens", f"Secret {NAME}-tunnel"]
    eventually(lambda: left() == secrets, "only the Secrets are left", 90.0)
