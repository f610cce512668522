"""`cloudrc mission`: foreign text stays in its line and cannot control the terminal."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from cloudrc.cli import mission as command
from cloudrc.cli.main import main
from cloudrc.cli.output import escape
from cloudrc.cluster import jobs
from cloudrc.cluster.jobs import JobStatus
from cloudrc.errors import BadInputError
from cloudrc.teleop.store import SHOWN as EVENTS
from cloudrc.teleop.store import Order
from tests.teleop.conftest import PLAN, Running, running

NAME = "far\x1b[2J\nm9  forged\r\x9b31m\x7f\u202e"
SHOWN = r"far\x1b[2J\nm9  forged\r\x9b31m\x7f\u202e"


@pytest.fixture
def api(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Running]:
    monkeypatch.chdir(tmp_path)
    with running(unix=True) as one:
        # Bypass the API, which refuses such a name: the journal of another version may hold it.
        made = one.bridge.submit(lambda service, now_ns: service.create(Order(PLAN, NAME), now_ns))
        made.result(10.0)
        yield one


def test_printable_text_stays_unchanged() -> None:
    assert escape("Zur Tür, 3 µm - 門") == "Zur Tür, 3 µm - 門"
    assert escape("\ud800\u2028\0") == r"\ud800\u2028\x00"


@pytest.mark.parametrize("words", ["list", "status", "status m1", "cancel", "hold"])
def test_a_missions_name_is_shown_without_effect(
    words: str, api: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    main(["mission", *words.split(), "--api", api.url])
    said = capsys.readouterr().out
    assert SHOWN in said
    assert [c for c in said if not c.isprintable() and c != "\n"] == []
    assert [line for line in said.splitlines() if line.startswith("m9")] == []


@pytest.mark.parametrize("form", ["json", "yaml"])
def test_documents_hold_the_name_in_printable_form(
    form: str, api: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mission", "list", "--api", api.url, "-o", form]) == 0
    said = capsys.readouterr().out
    assert [c for c in said if (c != "\n" and ord(c) < 32) or 127 <= ord(c) < 160] == []
    read = json.loads if form == "json" else yaml.safe_load
    assert read(said)["missions"][0]["name"] == NAME


class Hostile:
    """An API that answers with hostile text."""

    def post(self, path: str, body: object = None) -> dict[str, object]:
        return {"id": NAME, "state": NAME, "waypoints": 1}

    def get(self, path: str) -> dict[str, object]:
        event = {"id": 1, "mission": NAME, "time_s": 1.0, "text": NAME}
        failure = {"code": NAME, "text": NAME}
        verdict = {"outcome": NAME, "exit_code": 1, "failures": [failure]}
        return {"events": [event], "verdict": verdict}


def test_events_and_verdicts_are_shown_without_effect(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "termination-log"
    log.touch()
    monkeypatch.setattr(command, "TERMINATION_LOG", log)
    monkeypatch.setattr(command, "Api", lambda *_: Hostile())
    assert main(["mission", "fly", "--mission", "pipes", "--api", "unix:there"]) == 1
    assert main(["mission", "run", "pipes", "--api", "unix:there"]) == 1
    assert main(["mission", "logs", "m1", "--api", "unix:there"]) == 0
    for said, lines in ((capsys.readouterr().out, 7), (log.read_text(), 1)):
        assert len(said.splitlines()) == lines
        assert SHOWN in said
        assert [c for c in said if not c.isprintable() and c != "\n"] == []


def test_text_of_a_pod_is_shown_without_effect(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    job = JobStatus("job-1", "uid", "failed", "now", 1, NAME)
    monkeypatch.setattr(command, "_release", lambda options: None)
    monkeypatch.setattr(jobs, "list_jobs", lambda release: [job])
    monkeypatch.setattr(jobs, "logs", lambda release, name: [NAME])
    options = argparse.Namespace(id=None, output="table", follow=False, verb="list")
    for verb, lines in (("list", 2), ("logs", 1)):
        assert command.JOB_VERBS[verb](options) == 0
        said = capsys.readouterr().out
        assert len(said.splitlines()) == lines
        assert SHOWN in said


def test_a_refusal_of_the_api_is_shown_without_effect(api: Running) -> None:
    point = {"position_m": [99.0, 0.0, 1.0], NAME: 1}
    with pytest.raises(BadInputError) as refused:
        api.post_local("/v1/missions", {NAME: 2, "waypoints": [point]})
    lines = str(refused.value).split("\n")
    assert [line for line in lines if not line.isprintable()] == []
    assert SHOWN in str(refused.value)


@pytest.mark.parametrize("verb", ["status", "cancel", "logs"])
@pytest.mark.parametrize(
    "given", ["\x1b[31m", "m1?x", "m 1", "..", "a/b", "tür", "\udcff", "%", "m1#"]
)
def test_an_invalid_id_is_no_mission(
    verb: str, given: str, api: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["mission", verb, given, "--api", api.url]) == 5
    (line,) = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    shown = {"a/b": "Not Found", "\udcff": "no mission '\ufffd'"}
    assert shown.get(given, f"no mission '{escape(given)}'") in line


@pytest.mark.parametrize("words", ["status m1", "logs m1"])
def test_left_out_events_are_counted(
    words: str, api: Running, capsys: pytest.CaptureFixture[str]
) -> None:
    mission = api.flight.teleop.book.find("m1")
    before = mission.happened.total()
    for _ in range(EVENTS):
        noted = api.bridge.submit(lambda service, _: service.book.note(mission, "goto", "there"))
        noted.result(10.0)
    assert main(["mission", *words.split(), "--api", api.url]) == 0
    said = capsys.readouterr().out
    left_out = mission.happened.total() - EVENTS
    assert left_out >= before
    assert f"m1  {left_out} earlier events are not shown\n" in said
    assert said.count("\nm1 ") >= EVENTS
