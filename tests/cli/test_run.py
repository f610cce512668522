"""`cloudrc run` and `cloudrc report`: refused input, output and written files."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from cloudrc.cli import extras
from cloudrc.cli.main import main

SHORT = ["--set", "mission.steps.count=1", "--set", "mission.steps.period_s=1.0"]
"""Overrides of `steps` for one second of flight."""


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the figures, which take longer than the flight."""
    monkeypatch.setattr("cloudrc.report.write._write_page", lambda *arguments: None)


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("--mode local --seeds 3", 2, "virtual time"),
        ("--seeds 0", 2, "'0' is not a whole number from 1 to 100000"),
        ("--seed -1", 2, "--seed"),
        ("--seed 1 --seeds 2", 2, "not allowed with"),
        ("papper", 2, "paper"),
        ("no/such.yaml", 2, "no/such.yaml"),
        ("--set cloud.predictr=last_sample", 2, "predictor"),
        ("--set cloud.predictor=kalmann", 2, "last_sample"),
        ("--set link.uplink.loss=1.2", 2, "loss"),
        ("--set report.metrics=./no.py", 2, "no.py': there is no such file"),
        ("--set report.metrics=duratoin", 2, "did you mean duration?"),
        ("--set nonsense", 2, "key=value"),
    ],
)
def test_bad_input_gives_one_line_and_writes_nothing(
    line: str, code: int, words: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", *line.split()]) == code
    captured = capsys.readouterr()
    assert captured.err.startswith("cloudrc: error: ")
    assert captured.err.count("\n") == 1
    assert words in captured.err
    assert captured.out == ""
    assert list(folder.iterdir()) == []


def test_a_missing_extra_ends_with_3(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(extras.EXTRAS, "world", ("no_such_module",))
    assert main(["run", "--mode", "virtual"]) == 3
    assert "pip install 'cloudrc[world]'" in capsys.readouterr().err


def test_a_full_folder_is_refused(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "precious").write_text("data")
    assert main(["run", "steps", "--mode", "virtual", "--out", str(folder)]) == 2
    assert "never overwritten" in capsys.readouterr().err
    assert (folder / "precious").read_text() == "data"


@pytest.mark.usefixtures("no_page")
def test_json_output_is_only_the_report(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["run", "steps", "--mode", "virtual", "--out", "here", "-o", "json", *SHORT]
    assert main(line) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out) == json.loads((folder / "here/report.json").read_text())
    assert captured.out == (folder / "here/report.json").read_text()
    assert captured.err == ""


def test_the_last_line_is_the_report_and_the_folder_is_complete(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "steps", "--mode", "virtual", "--seed", "7", *SHORT]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("steps: mode virtual, seed 7, link paper-p3")
    assert any(line.startswith("SUCCESS") for line in lines)
    page = folder / lines[-1]
    assert page == folder / "runs" / "steps-virtual-seed7-1" / "report.html"
    left = {path.name for path in page.parent.iterdir()}
    wanted = "report.html report.json mission.mcap config.yaml environment.json figures"
    assert set(wanted.split()) <= left
    assert (folder / "runs/latest/report.html").samefile(page)


@pytest.mark.usefixtures("no_page")
def test_a_mission_that_fails_its_criteria_ends_with_1(
    capsys: pytest.CaptureFixture[str],
) -> None:
    line = ["run", "steps", "--mode", "virtual", *SHORT, "--set", "criteria.contact=true"]
    assert main(line) == 1
    assert "FAILURE: " in capsys.readouterr().out


@pytest.mark.usefixtures("no_page")
def test_the_resolved_file_flies_the_same_run_again(folder: Path) -> None:
    first = ["run", "steps", "--mode", "virtual", "--seed", "3", *SHORT, "--out", "a"]
    assert main(first) == 0
    assert main(["run", "a/config.yaml", "--mode", "virtual", "--out", "b"]) == 0
    hashes = [json.loads((folder / d / "report.json").read_text())["records_sha256"] for d in "ab"]
    assert hashes[0] == hashes[1]


@pytest.mark.parametrize("output", ["table", "json"])
@pytest.mark.usefixtures("no_page")
def test_a_closed_pipe_does_not_end_the_run(
    output: str, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in `cloudrc run | head -1`; the exit code still follows the verdict, here 1."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed_pipe:
        monkeypatch.setattr("sys.stdout", closed_pipe)
        line = ["run", "steps", "--mode", "virtual", "--out", "here", "-o", output, *SHORT]
        assert main([*line, "--set", "criteria.contact=true"]) == 1
    left = {path.name for path in (folder / "here").iterdir()}
    assert {"mission.mcap", "report.json", "config.yaml"} <= left


def test_a_report_is_written_again(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def write_page(folder: Path, *assessment: object) -> None:
        (folder / "report.html").write_text("drawn elsewhere")

    monkeypatch.setattr("cloudrc.report.write._write_page", write_page)
    assert main(["run", "steps", "--mode", "virtual", *SHORT, "--out", "run"]) == 0
    before = (folder / "run/report.json").read_text()
    for name in ("report.json", "report.html"):
        (folder / "run" / name).unlink()
    capsys.readouterr()
    assert main(["report", "run"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "run/report.html"
    assert (folder / "run/report.html").is_file()
    after = json.loads((folder / "run/report.json").read_text())
    assert after["numbers"] == json.loads(before)["numbers"]


@pytest.mark.parametrize("name", ["missing", "empty"])
def test_a_report_needs_a_recorded_run(
    name: str, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "empty").mkdir()
    assert main(["report", name]) == 2
    assert capsys.readouterr().err.startswith("cloudrc: error: ")
