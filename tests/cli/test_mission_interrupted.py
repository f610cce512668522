"""`cloudrc mission run`, interrupted: the command that it prints cancels this mission only."""

from __future__ import annotations

from pathlib import Path

import pytest

from cloudrc.cli import mission as command
from cloudrc.cli.client import Api
from cloudrc.cli.main import main
from tests.teleop.conftest import running

FILE = "name: one\nstart: here\nwaypoints: [{position_m: [0.5, 0.0, 1.0]}]\n"


def _interrupted(*arguments: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize(
    ("flags", "word"), [([], "is still flying"), (["--queue"], "is waiting or flying")]
)
def test_the_printed_command_cancels_this_mission(
    flags: list[str],
    word: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = tmp_path / "one.yaml"
    path.write_text(FILE)
    monkeypatch.setattr(command.MissionFollower, "follow", _interrupted)
    with running(unix=True) as api:
        others = ["m1"] if flags else []
        for _ in others:
            api.post_local("/v1/missions", {"waypoints": [{"position_m": [0.5, -1.0, 1.0]}]})
        assert main(["mission", "run", str(path), "--api", api.url, *flags]) == 130
        mine = f"m{1 + len(others)}"
        (advice,) = (
            line for line in capsys.readouterr().err.splitlines() if line.startswith("mission")
        )
        assert advice == f"mission {mine} {word}; cancel it: cloudrc mission cancel {mine}"
        assert main([*advice.split("cloudrc ")[1].split(), "--api", api.url]) == 0
        missions = Api(api.url).get("/v1/missions")["missions"]
        states = {each["id"]: each["state"] for each in missions}
        assert states.pop(mine) == "cancelled"
        assert [states[other] in ("starting", "flying") for other in others] == [True] * len(others)
