"""The commands in helm's notes work, `helm test` passes, uninstalling leaves only Secrets."""

import shlex

import pytest

from tests.e2e.conftest import EXAMPLES, NAME, cloudrc, command, eventually, helm, kubectl, read

KINDS = "deployment,service,configmap,networkpolicy,secret,serviceaccount,pvc,job,pod"


@pytest.mark.full
def test_the_commands_of_the_notes_work_as_printed(installed):
    """Each command ends by itself; the second one flies `pipes`, for half a minute."""
    printed = [line for line in helm("get", "notes", NAME).splitlines() if line.startswith("  ")]
    wait, mission, logs = (shlex.split(line) for line in printed)
    assert "condition met" in command(*wait)
    done = cloudrc(*mission[1:])
    assert (mission[0], done.returncode) == ("cloudrc", 0), done.stdout + done.stderr
    assert command(*logs).strip(), "the link names its shaper"


def test_helm_test_flies_and_passes(installed):
    said = helm("test", NAME, "--timeout=300s", timeout=500.0)
    assert "Phase:          Succeeded" in said


def test_uninstalling_leaves_only_the_secrets(installed):
    """The Jobs of `cloudrc mission run` are deleted, too; a Job that a user applied is not."""
    kubectl("delete", f"--filename={EXAMPLES / 'mission-paper.yaml'}", "--ignore-not-found")
    helm("uninstall", NAME, "--wait")

    def left():
        found = read(KINDS, f"--selector=app.kubernetes.io/instance={NAME}")["items"]
        return sorted(f"{one['kind']} {one['metadata']['name']}" for one in found)

    secrets = [f"Secret {NAME}-tokens", f"Secret {NAME}-tunnel"]
    eventually(lambda: left() == secrets, "only the Secrets are left", 90.0)
