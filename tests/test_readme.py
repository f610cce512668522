# SPDX-License-Identifier: Apache-2.0

"""The commands and the files in README.md and in some pages of docs/ work."""

import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from tests.conftest import nightly
from tests.support.camera import needs_renderer

ROOT = Path(__file__).resolve().parents[1]
PAGES = (
    "README.md",
    "docs/tour.md",
    "docs/experiment.md",
    "docs/plugins.md",
    "docs/plugins-predictor.md",
    "docs/plugins-controller.md",
    "docs/plugins-metric.md",
    "docs/scene.md",
)
TEXT = "\n".join((ROOT / page).read_text() for page in PAGES)

BLOCK = re.compile(r"(?:<!-- test: (\S+) -->\n)?```(\w+)\n(.*?)```", re.DOTALL)
FILES = {name: body for name, _, body in BLOCK.findall(TEXT) if name}
LINES = [
    line.partition(" #")[0].strip()
    for _, language, body in BLOCK.findall(TEXT)
    if language == "bash"
    for line in body.splitlines()
]
REFUSED = [
    (line.removeprefix("$ "), body.partition("\n")[2])
    for _, language, body in BLOCK.findall(TEXT)
    if language == "console"
    for line in body.splitlines()[:1]
]
"""Commands that cloudrc refuses, with what it prints."""
UNTESTED = {"", "make test", "make live", ".venv/bin/cloudrc up --console"}
"""Lines that are not run here: steps of .ci/run, and one that tests/doors/console tests, because it
runs until Ctrl-C."""
COMMANDS = [line for line in LINES if line not in UNTESTED]
ANSWERS = {"compare": "B has a lower", "margin": "settles up to", "capacity": "runs/capacity"}
"""Subcommand with many flights -> beginning of the last line that it prints."""


def is_slow(command):
    """Tell whether a command runs in real time or flies many times."""
    many = "--seeds" in command or command.split()[1] in ANSWERS
    return command.startswith("make") or "--mode local" in command or many


QUICK = [command for command in COMMANDS if not is_slow(command)]
SLOW = [command for command in COMMANDS if is_slow(command)]
SWEEPS = [command for command in SLOW if "--seeds" in command]
# A step of .ci/run flies in mode local; of the sweeps, only the first flies daily.
STEPS = [command for command in SLOW if "--mode local" in command]
NIGHTLY = [*STEPS, *(c for c in SLOW if c.split()[1] in ANSWERS), *SWEEPS[1:]]
FLIGHTS = [command for command in QUICK if command.startswith("cloudrc run")]


def execute(command, folder):
    words = shlex.split(command)
    if words[0] == "cloudrc":
        words = [sys.executable, "-m", *words]
    where = ROOT if words[0] == "make" else folder
    # A make inside make prints the folder that it enters and leaves.
    plain = {key: value for key, value in os.environ.items() if not key.startswith("MAKE")}
    environment = {**plain, "PYTHONPATH": str(ROOT), "COLUMNS": "80"}
    return subprocess.run(words, cwd=where, capture_output=True, text=True, env=environment)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make a working folder with the files that the pages describe."""
    path = tmp_path_factory.mktemp("readme")
    for name, body in FILES.items():
        (path / name).write_text(body)
    return path


def test_the_python_of_the_readme_prints_what_it_shows(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shown = {language: body for _, language, body in BLOCK.findall((ROOT / PAGES[0]).read_text())}
    (tmp_path / "ten_lines.py").write_text(shown["python"])
    runpy.run_path("ten_lines.py")
    assert capsys.readouterr().out == shown["text"]


PROGRESS = re.compile(r"(([a-z]+s| +[\d.]+ s) .*\n)*")
"""What a quick command says on a busy machine."""


def test_the_first_flight_works(folder, monkeypatch, call):
    monkeypatch.chdir(folder)
    out, error = call("", *shlex.split(FLIGHTS[0])[1:])
    assert PROGRESS.fullmatch(error)
    assert (folder / out.splitlines()[-1]).name == "report.html"
    assert (folder / out.splitlines()[-1]).is_file()


@pytest.mark.parametrize("command", [c for c in QUICK if c not in FLIGHTS])
def test_a_command_works(command, folder, monkeypatch, call):
    monkeypatch.chdir(folder)
    _, *words = shlex.split(command)
    assert PROGRESS.fullmatch(call("", *words).err)


@pytest.mark.process
@pytest.mark.parametrize("command", [*(c for c in SLOW if c not in NIGHTLY), *nightly(*NIGHTLY)])
def test_a_slow_command_works(command, folder):
    done = execute(command, folder)
    assert done.returncode == 0, done.stdout + done.stderr
    lines, answer = done.stdout.splitlines(), ANSWERS.get(command.split()[1])
    if command == "make demo":
        lines, folder = [line for line in lines if line.endswith("report.html")], ROOT
    assert lines[-1].startswith(answer) if answer else (folder / lines[-1]).is_file()


@pytest.fixture
def numbers_only(folder, monkeypatch, no_page):
    """Fly in this process and without figures, which is fast."""
    monkeypatch.chdir(folder)


@pytest.mark.parametrize(("command", "printed"), REFUSED)
def test_a_command_is_refused_as_the_page_shows(command, printed, folder, monkeypatch, call):
    monkeypatch.chdir(folder)
    _, *words = shlex.split(command)
    assert call("", *words, code=2).err == printed


@pytest.mark.usefixtures("numbers_only")
@pytest.mark.parametrize("is_whole", [False, *nightly(True)])
@pytest.mark.parametrize(
    "command",
    [pytest.param(each, marks=needs_renderer if "follow" in each else ()) for each in FLIGHTS[1:]],
)
def test_another_flight_works(command, is_whole, call):
    """By default only the first seconds of it are flown, so that its mission fails."""
    short = [] if is_whole else ["--set", "criteria.time_limit_s=2"]
    captured = call("", *shlex.split(command)[1:], *short, code=0 if is_whole else 1)
    too_short = "" if is_whole else r"cloudrc: warning: .*\n"
    assert PROGRESS.fullmatch(re.sub(too_short, "", captured.err))
    # A loop that the CPU limit stalls misses periods.
    assert ("faults noted" in captured.out) == ("cpu_share" in command)
    folder = Path(captured.out.splitlines()[-1]).parent
    recording = "robot-0/mission.mcap" if "fleet" in command else "mission.mcap"
    assert (folder / "report.json").exists()
    assert (folder / recording).exists()


@pytest.mark.usefixtures("numbers_only")
def test_the_tour_s_way_to_read_a_recording_works(folder, call):
    call("run hover --mode virtual --set mission.waypoints.0.dwell_s=1")
    done = execute(f"{sys.executable} read_recording.py", folder)
    assert done.returncode == 0, done.stderr
    assert "the base is at" in done.stdout


@pytest.mark.usefixtures("numbers_only")
def test_the_predictor_and_the_metric_of_the_pages_work(as_json):
    """Compare a share of 0.5 with a share of 1, which is the predictor `constant_velocity`."""
    fly = "run steps --mode virtual --set mission.steps.count=3"
    fly += " --set cloud.predictor=./my_predictor.py --set report.metrics=./overshoot.py"
    report = "report runs/latest --metric ./overshoot.py"
    found = []
    for line in (*(f"{fly} --set cloud.predictor.share={share}" for share in (0.5, 1.0)), report):
        numbers = as_json(line)["numbers"]
        found.append({name: number["value"] for name, number in numbers.items()})
    half, whole, again = found
    assert half["fault_count"] == whole["fault_count"] == 0
    assert half["prediction_error_rms"] > 1.5 * whole["prediction_error_rms"]
    assert whole["overshoot"] == again["overshoot"]
