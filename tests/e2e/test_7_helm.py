# SPDX-License-Identifier: Apache-2.0

"""The commands in helm's notes work, and `helm test` passes."""

import shlex

import pytest

from tests.e2e.conftest import NAME, cloudrc, command, helm, until_ready


@pytest.mark.full
def test_the_commands_of_the_notes_work_as_printed(installed):
    """Each command ends by itself; the second one flies `pipes`, for half a minute."""
    printed = [line for line in helm("get", "notes", NAME).splitlines() if line.startswith("  ")]
    wait, mission, logs = (shlex.split(line) for line in printed)
    assert "condition met" in command(*wait)
    done = cloudrc(*mission[1:])
    assert (mission[0], done.returncode) == ("cloudrc", 0), done.stdout + done.stderr
    assert command(*logs).strip(), "the link names its shaper"


@pytest.mark.real_time
def test_helm_test_flies_and_passes(installed):
    until_ready()
    said = helm("test", NAME, "--timeout=300s", timeout=500.0)
    assert "Phase:          Succeeded" in said
