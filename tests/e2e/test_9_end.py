# SPDX-License-Identifier: Apache-2.0

"""Uninstalling leaves only Secrets."""

from tests.e2e.conftest import NAME, eventually, helm, read

KINDS = "deployment,service,configmap,networkpolicy,secret,serviceaccount,pvc,job,pod"


def test_uninstalling_leaves_only_the_secrets(installed):
    """The Jobs of `cloudrc mission run` are deleted, too."""
    helm("uninstall", NAME, "--wait")

    def left():
        found = read(KINDS, f"--selector=app.kubernetes.io/instance={NAME}")["items"]
        return sorted(f"{one['kind']} {one['metadata']['name']}" for one in found)

    secrets = [f"Secret {NAME}-tokens", f"Secret {NAME}-tunnel"]
    eventually(lambda: left() == secrets, "only the Secrets are left", 180.0)
