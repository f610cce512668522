# SPDX-License-Identifier: Apache-2.0

"""Commands over a schedule: what they say, and what rows and reports have."""

import json

import pytest

from cloudrc.link.library import read_profile

SHORT = "--set link.profile=handover --set mission.steps.count=1"
LINE = "2 seeds, one link schedule: --set link.start_s=random"


def rows_of(folder):
    return [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]


@pytest.mark.usefixtures("one_core")
def test_seeds_over_one_schedule_are_told_and_begin_at_0(call, tmp_path):
    found = {}
    for start in ("null", "random"):
        out = tmp_path / start
        told = call(f"run steps --seeds 2 {SHORT} --set link.start_s={start} --out", out).err
        assert (LINE in told) is (start == "null")
        found[start] = rows_of(out)
    assert [row["link_start"] for row in found["null"]] == [0.0, 0.0]
    first, second = (row["link_start"] for row in found["random"])
    assert 0.0 < first != second < 30.0


def test_a_report_has_the_start(call, tmp_path):
    out = tmp_path / "run"
    call(f"run steps --mode virtual {SHORT} --set link.start_s=2.5 --report none --out", out)
    assert json.loads((out / "report.json").read_text())["link_start"] == 2.5


def test_a_capacity_trace_becomes_a_profile(call, tmp_path):
    (tmp_path / "drive.down").write_text("12\n24\n36\n")
    out = tmp_path / "sub" / "drive.yaml"
    out.parent.mkdir()
    shown = call("link record", tmp_path / "drive.down", "-o", out).out
    assert "3 opportunities of 1500 bytes, 1000 kbit/s" in shown
    assert read_profile(out).downlink.opportunities == (12_000_000, 24_000_000, 36_000_000)
    assert (
        "leave out --halve-rtt"
        in call(
            "link record --halve-rtt", tmp_path / "drive.down", "-o", tmp_path / "b.yaml", code=2
        ).err
    )
