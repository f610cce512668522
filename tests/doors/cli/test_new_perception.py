# SPDX-License-Identifier: Apache-2.0

"""`cloudrc new perception` writes a file that drives."""

import pytest

from tests.support.camera import needs_renderer


@pytest.mark.parametrize(
    ("experiment", "option", "short"),
    [
        ("gap", "", ""),
        pytest.param(
            "follow", "--camera", "--set mission.follow.duration_s=6", marks=needs_renderer
        ),
    ],
)
def test_a_new_perception_moves_the_robot(tmp_path, monkeypatch, call, experiment, option, short):
    monkeypatch.chdir(tmp_path)
    said = call(f"new perception mine.py {option}").out
    mine = f"run {experiment} --mode virtual --set cloud.perception=./mine.py"
    assert mine in said
    flown = call(f"{mine} --report none --out run {short}")
    assert "SUCCESS" in flown.out
    assert "perception_failed" not in flown.out


@pytest.mark.parametrize(("file", "why"), [("mine", ".py"), ("mine.py", "exists already")])
def test_what_is_there_stays(tmp_path, monkeypatch, refused, file, why):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("mine")
    assert why in refused(f"new perception {file}")
    assert (tmp_path / "mine.py").read_text() == "mine"
