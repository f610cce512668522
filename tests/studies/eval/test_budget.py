# SPDX-License-Identifier: Apache-2.0

"""Rows of an evaluation have the stages of the age, and an episode can keep its timeline."""

import csv
import json

import pytest

from cloudrc.gym.answers import STAGES


def test_rows_have_the_stages_and_a_kept_timeline_has_the_same(law, evaluate, tmp_path, call):
    out, rows = tmp_path / "out", tmp_path / "rows.csv"
    asked = ["--policy", law(), "--link", "lte", "--rtt", "60", "--compute", ".005", "--seeds", "1"]
    evaluate(*asked, "--out", str(out), "--rows", str(rows), "--keep", "timeline")
    names = sorted(path.name for path in (out / "timelines").iterdir())
    assert names == ["newest-60ms-seed1.json", "no-network-seed1.json"]
    found = json.loads(call(f"timeline {out}/timelines/{names[0]} -o json").out)
    stages = found["budgets"]["episode"]["stages"]
    with rows.open() as file:
        played = [*csv.DictReader(file)]
    row = next(each for each in played if each["rtt_ms"] == "60.0")
    columns = {name: float(each) for name, each in row.items() if name.startswith("budget_")}
    expected = {f"budget_{name} [s]": stages[name]["mean"] for name in STAGES}
    assert columns == pytest.approx(expected, abs=1e-9)
    assert stages["compute"]["mean"] == pytest.approx(0.005, rel=0.1)
    assert json.loads((out / "timelines/newest-60ms-seed1-timeline.json").read_bytes())
