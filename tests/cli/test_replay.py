"""`cloudrc replay`: the page of a run or of a recording, and refused input."""

import pytest

from cloudrc.cli.main import main
from tests.cli.test_run import FLY


@pytest.fixture
def run(folder, monkeypatch):
    """Fly a run without a page, and count the pages that are opened."""
    monkeypatch.setattr("cloudrc.report.write._write_page", lambda *assessment: None)
    main([*FLY, "--out", "a"])
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    return opened


def test_the_replay_of_a_run_is_written_and_opened(run, folder, capsys):
    capsys.readouterr()
    assert main(["replay", "a"]) == 0
    out, err = capsys.readouterr()
    assert out == "a/replay.html\n"
    assert "no browser" in err
    assert run == [(folder / "a/replay.html").as_uri()]
    assert main(["replay", "a/mission.mcap", "--out", "b.html", "--no-open"]) == 0
    assert capsys.readouterr() == ("b.html\n", "")
    assert (folder / "b.html").read_text() == (folder / "a/replay.html").read_text()
    assert len(run) == 1
    assert main(["replay", "a", "--out", "b.html"]) == 2
    assert "b.html: already there" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["nothing", "empty", "text.mcap"])
def test_what_is_no_run_gives_one_line(name, folder, capsys):
    (folder / "empty").mkdir()
    (folder / "text.mcap").write_text("no recording")
    assert main(["replay", name]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert name in err
