"""CPU throttling is read from the kernel's files of both cgroup versions."""

from __future__ import annotations

from pathlib import Path

import pytest

from cloudrc.drivers.exporter import Throttling, read_throttling

VERSION_2 = """\
usage_usec 4402130
user_usec 3301211
system_usec 1100919
nr_periods 120
nr_throttled 17
throttled_usec 1250000
nr_bursts 0
burst_usec 0
"""
VERSION_1 = "nr_periods 120\nnr_throttled 17\nthrottled_time 1250000000\n"
ROOT_GROUP = "usage_usec 4402130\nuser_usec 3301211\nsystem_usec 1100919\n"


@pytest.mark.parametrize(
    ("place", "text"),
    [
        ("cpu.stat", VERSION_2),
        ("cpu/cpu.stat", VERSION_1),
        ("cpu,cpuacct/cpu.stat", VERSION_1),
    ],
)
def test_both_versions_tell_the_same(tmp_path: Path, place: str, text: str) -> None:
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).write_text(text)
    assert read_throttling(tmp_path) == Throttling(120, 17, pytest.approx(1.25))


@pytest.mark.parametrize("text", [None, "", ROOT_GROUP])
def test_where_the_kernel_counts_nothing_there_is_nothing(tmp_path: Path, text: str | None) -> None:
    if text is not None:
        (tmp_path / "cpu.stat").write_text(text)
    assert read_throttling(tmp_path) is None
