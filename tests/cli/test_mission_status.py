"""`cloudrc mission status` while the robot or cloud is silent: old values are marked as old."""

from __future__ import annotations

from typing import Any

import pytest

from cloudrc.cli.main import main
from cloudrc.teleop.service import NO_CLOUD, NOT_HEARD

SEEN = {
    "position_m": [1.0, 2.0, 0.7],
    "rtt_s": 0.09,
    "guard": "TRACK",
    "cause": "fresh command",
}


class Api:
    """An API with a fixed state."""

    state: dict[str, Any]

    def __init__(self, *_: object) -> None:
        pass

    def get(self, path: str) -> dict[str, Any]:
        return {"mission": None, "queue": [], **self.state}


def status(
    patch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], **state: object
) -> list[str]:
    patch.setattr("cloudrc.cli.mission.Api", Api)
    patch.setattr(Api, "state", state, raising=False)
    assert main(["mission", "status", "--api", "unix:there"]) == 0
    return capsys.readouterr().out.splitlines()[1:]


@pytest.mark.parametrize(
    ("cloud_age", "heard", "next_step"),
    [(0.1, "cloud heard 0.1 s ago", NOT_HEARD), (3.1, "cloud heard 3.1 s ago", NO_CLOUD)],
)
def test_a_robot_that_is_not_heard_has_no_present_state(
    cloud_age: float,
    heard: str,
    next_step: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    seen = {**SEEN, "age_s": 3.2, "guard_for_s": None, "next_step": next_step}
    assert status(monkeypatch, capsys, seen=seen, cloud_age_s=cloud_age) == [
        f"robot not heard for 3.2 s (guard TRACK then); {heard}",
        "last seen at (1.00, 2.00, 0.70) m: fresh command",
        f"next: {next_step}",
    ]


def test_a_robot_that_is_heard_has_a_present_state(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    seen = {**SEEN, "age_s": 0.02, "guard_for_s": 4.5, "next_step": "the robot flies"}
    assert status(monkeypatch, capsys, seen=seen, cloud_age_s=0.02) == [
        "robot at (1.00, 2.00, 0.70) m, seen 0.02 s ago, round trip 90 ms",
        "guard TRACK for 4.5 s: fresh command",
        "next: the robot flies",
    ]


@pytest.mark.parametrize(("age", "heard"), [(None, "never"), (0.1, "0.1 s ago")])
def test_before_the_first_telemetry_cloud_is_mentioned(
    age: float | None,
    heard: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (line,) = status(monkeypatch, capsys, seen=None, cloud_age_s=age)
    assert line == f"no telemetry from the robot yet; is the link up? cloud heard {heard}"
