# SPDX-License-Identifier: Apache-2.0

"""`cloudrc new perception` writes a file that drives."""

import pytest


def test_a_new_perception_drives_the_corridor(tmp_path, monkeypatch, call):
    monkeypatch.chdir(tmp_path)
    said = call("new perception mine.py").out
    assert "cloud.perception=./mine.py" in said
    flown = call("run gap --mode virtual --set cloud.perception=./mine.py --report none --out run")
    assert "SUCCESS" in flown.out
    assert "perception_failed" not in flown.out


@pytest.mark.parametrize(("file", "why"), [("mine", ".py"), ("mine.py", "exists already")])
def test_what_is_there_stays(tmp_path, monkeypatch, refused, file, why):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text("mine")
    assert why in refused(f"new perception {file}")
    assert (tmp_path / "mine.py").read_text() == "mine"
