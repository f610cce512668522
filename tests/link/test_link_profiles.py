"""Each shipped profile loads, has a description and leaves time for commands."""

from __future__ import annotations

import json
from importlib.resources import files

import pytest
import yaml

from cloudrc.config.schema import Direction, Profile

FOLDER = files("cloudrc.link") / "profiles"
TEXTS = {f.name.removesuffix(".yaml"): f.read_text() for f in FOLDER.iterdir()}
SHIPPED = """ideal paper-p1 paper-p2 paper-p3 wifi lte 5g satellite handover lossy""".split()


def load(name: str) -> Profile:
    return Profile.model_validate_json(json.dumps(yaml.safe_load(TEXTS[name])))


def test_all_are_there() -> None:
    assert set(TEXTS) >= set(SHIPPED)


@pytest.mark.parametrize("name", sorted(TEXTS))
def test_a_profile_loads_with_a_short_description(name: str) -> None:
    assert 10 < len(load(name).description) <= 90


@pytest.mark.parametrize("name", sorted(TEXTS))
def test_a_profile_leaves_time_for_a_command_to_come_back(name: str) -> None:
    """Mean round trip plus a period of odometry and of commands is below the command age limit."""
    profile = load(name)
    round_trip = profile.uplink.delay_ms + profile.downlink.delay_ms
    assert round_trip + 20 < (profile.command_age_max_ms or 250)


@pytest.mark.parametrize(
    ("name", "delay", "jitter"),
    [("ideal", 0, 0), ("paper-p1", 20, 10), ("paper-p2", 45, 25), ("paper-p3", 70, 40)],
)
def test_the_papers_profiles_are_the_papers(name: str, delay: float, jitter: float) -> None:
    profile = load(name)
    assert profile.uplink == Direction(delay_ms=delay, jitter_ms=jitter) == profile.downlink
