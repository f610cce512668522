# SPDX-License-Identifier: Apache-2.0

"""`cloudrc replay`: the page of a run or of a recording, and refused input."""

import pytest

from cloudrc.doors.cli.main import main
from tests.doors.cli.conftest import FLY


@pytest.mark.usefixtures("no_page")
def test_the_replay_of_a_run_is_written_and_opened(folder, monkeypatch, call):
    main([*FLY, "--out", "a"])
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "BROWSER"):
        monkeypatch.delenv(name, raising=False)
    assert call("replay a").out == "a/replay.html\n"
    assert opened == [], "a text browser would take over the terminal"
    monkeypatch.setenv("DISPLAY", ":0")
    out, err = call("replay a")
    assert out == "a/replay.html\n"
    assert "no browser" in err
    assert opened == [(folder / "a/replay.html").as_uri()]
    assert call("replay a/mission.mcap --out b.html --no-open") == ("b.html\n", "")
    assert (folder / "b.html").read_text() == (folder / "a/replay.html").read_text()
    assert len(opened) == 1
    assert "b.html: already there" in call("replay a --out b.html", code=2).err
