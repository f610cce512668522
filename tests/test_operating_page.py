"""The page for operators keeps its word: its routes, answers, verbs and codes are real ones."""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import TypeAlias

import pytest
from samples import world_records

from cloudrc import assembly
from cloudrc.cli.main import main
from cloudrc.cloud.teleop.api import Surroundings, create_app
from cloudrc.cloud.teleop.api_bridge import Bridge
from cloudrc.geometry.scene import load_scene
from cloudrc.record.writer import McapWriter

PAGE = (Path(__file__).resolve().parents[1] / "docs" / "operating.md").read_text(encoding="utf-8")
Paths: TypeAlias = dict[str, dict[str, dict[str, dict[str, object]]]]
SHOWN = re.search(r"^\$ cloudrc (recover torn\.mcap)\n(.*?)^```", PAGE, re.MULTILINE | re.DOTALL)


@pytest.fixture(scope="module")
def described() -> Paths:
    around = Surroundings(load_scene("pipes"), 60.0, True, assembly.mission_plan)
    paths: Paths = create_app(Bridge(), around).openapi()["paths"]
    return paths


def test_it_names_every_route_and_no_other(described: Paths) -> None:
    told = re.findall(r"`(GET|POST) (/\S+)`", PAGE)
    named = {(verb.lower(), f"/v1{path}") for verb, path in told}
    assert named == {(verb, path) for path, verbs in described.items() for verb in verbs}


def test_an_answer_that_it_explains_is_one_that_there_is(described: Paths) -> None:
    named = set(re.findall(r"\b[45]\d\d\b", " ".join(re.findall(r"^\| ([45].*?) \|", PAGE, re.M))))
    given = {
        code for way in described.values() for each in way.values() for code in each["responses"]
    }
    assert {"401", "403", "429", "503"} <= named <= given


@pytest.mark.parametrize("verb", sorted(set(re.findall(r"`cloudrc mission (\w+)", PAGE))))
def test_a_verb_is_one_of_missions(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["mission", verb, "--help"])
    assert ended.value.code == 0
    assert f"cloudrc mission {verb}" in capsys.readouterr().out


def test_a_torn_recording_is_recovered_as_it_shows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert SHOWN
    command, shown = SHOWN.groups()
    monkeypatch.chdir(tmp_path)
    whole = io.BytesIO()
    writer = McapWriter(whole, clock="world")
    writer.write(world_records(160))
    writer.close()
    data = whole.getvalue()
    Path("torn.mcap").write_bytes(data[: len(data) // 2])
    assert main(command.split()) == 1
    plain = re.compile(r"[\d.]+")
    assert plain.sub("0", capsys.readouterr().out) == plain.sub("0", shown)
