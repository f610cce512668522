# SPDX-License-Identifier: Apache-2.0

"""The number of usable cores follows the affinity and the CPU limits of the control groups."""

import os

import pytest

from cloudrc.flight import machine


@pytest.mark.parametrize(
    ("group", "limits", "cores"),
    [
        ("0::/\n", {"": "200000 100000"}, 2),  # in a container
        ("1:cpu:/x\n0::/a/b\n", {"a": "150000 100000", "a/b": "max 100000"}, 2),
    ],
)
def test_the_smallest_limit_counts(group, limits, cores, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: range(4), raising=False)
    monkeypatch.setattr(machine, "CGROUP", tmp_path / "cgroup")
    monkeypatch.setattr(machine, "CGROUPS", tmp_path / "groups")
    (tmp_path / "cgroup").write_text(group)
    for path, text in limits.items():
        (tmp_path / "groups" / path).mkdir(parents=True, exist_ok=True)
        (tmp_path / "groups" / path / "cpu.max").write_text(f"{text}\n")
    assert machine.usable_cores() == cores
