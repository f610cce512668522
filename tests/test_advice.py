"""Warnings before a flight: settings that do not fit together, with a key and value that would."""

import re

import pytest

from cloudrc.advice import advise
from cloudrc.config import shipped
from cloudrc.config.load import load_experiment
from tests.conftest import nightly
from tests.flights.conftest import both_ways, fly, numbers


def both(delay, jitter, **others):
    return ["link.profile=ideal", *both_ways(delay_ms=delay, jitter_ms=jitter, **others)]


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (both(125, 50), ("holds again and again; ", "guard.command_age_max_ms=")),
        (both(750, 0), ("never flies; ", "guard.command_age_max_ms=")),
        (both(750, 0), ("more than cloud predicts; ", "cloud.horizon_max_s=")),
        (
            ["link.profile=paper-p3", "cloud.freeze_after_s=0.05"],
            ("cloud freezes at times; ", "cloud.freeze_after_s="),
        ),
        (["cloud.controller={name: pid, gain_i: [0.3, 0, 0]}"], ("cloud.controller.speed_max=6",)),
        (["mission=carrot", "mission.carrot.speed_mps=8"], ("instead of 8 m/s", "speed_mps=")),
        (["world.wind.velocity_mps=[0, -3]"], ("0.19 m from", "low_level.integral_limit_xy=")),
        (["world.plant.payload_kg=0.4"], ("0.20 m from", "low_level.integral_limit_z=")),
        (
            ["world.odometry_rate_hz=20", "cloud.compute_ms=60", "guard.command_age_max_ms=200"],
            ("holds again and again; ", "guard.command_age_max_ms="),
        ),
        (
            [
                "cloud.predictor=commanded_velocity",
                "cloud.controller.gain_p=[6, 6, 6]",
                *both(100, 0),
            ],
            ("above 1", "gains below"),
        ),
    ],
)
def test_what_does_not_fit_is_named_and_the_named_value_fits(settings, words):
    texts = list(advise(load_experiment("paper", settings)))
    assert any(all(word in text for word in words) for text in texts), texts
    fits = dict(re.findall(r"--set ([\w.]+)=(\S+)", " ".join(texts)))
    if fits:
        others = [each for each in settings if each.partition("=")[0] not in fits]
        changed = [*others, *(f"{key}={value}" for key, value in fits.items())]
        assert list(advise(load_experiment("paper", changed))) == []


@pytest.mark.parametrize("profile", shipped.names("profile"))
def test_each_shipped_profile_is_flown_without_a_warning(profile):
    assert list(advise(load_experiment("paper", [f"link.profile={profile}"]))) == []


@pytest.mark.parametrize(
    "conditions",
    [
        (90, 50, {}),
        (110, 20, {}),
        *nightly((70, 60, {}), (100, 40, {}), (100, 40, {"distribution": "pareto"})),
        *nightly((70, 40, {"distribution": "normal"}), (120, 5, {}), (200, 150, {})),
    ],
)
def test_a_hold_is_announced_if_and_only_if_the_guard_holds(conditions):
    delay, jitter, others = conditions
    settings = both(delay, jitter, **others)
    warned = any("guard" in text for text in advise(load_experiment("steps", settings)))
    assert warned == (numbers(fly("steps", *settings))["hold_count"] > 0)
