# SPDX-License-Identifier: Apache-2.0

"""The working folder of each command, and calls of commands."""

import pytest

KEYS = "mission.steps.count=1", "mission.steps.period_s=1.0", "criteria.settle_m=null"
SHORT = [f"--set={key}" for key in KEYS]
"""Overrides of `steps` for one second of flight."""
FLY = ["run", "steps", "--mode", "virtual", *SHORT]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Work in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def replace_flights(one_core, monkeypatch):
    """Return a function that replaces flights by `fly(experiment)`, in this process."""
    return lambda fly: monkeypatch.setattr("cloudrc.flight.in_memory.measure", fly)
