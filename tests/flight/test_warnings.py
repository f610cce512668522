# SPDX-License-Identifier: Apache-2.0

"""Warnings before a flight: settings that do not fit together, with a key and value that would."""

import re

import pytest

from cloudrc.config import shipped
from cloudrc.config.load import load_experiment
from cloudrc.flight.warnings import advise
from tests.conftest import nightly_rows
from tests.flights.conftest import both_ways, fly, numbers

pytestmark = pytest.mark.usefixtures("shared_files")


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
        (
            [
                "cloud.predictor=kalman",
                "cloud.plan_s=0.4",
                "cloud.send_delta_mps=0.05",
                "cloud.beat_s=0.2",
            ],
            ("less than 4 beats", "cloud.beat_s=0.1"),
        ),
        (["cloud.controller=mpc"], ("may be unstable", "cloud.predictor=model_based")),
        (["world.wind.velocity_mps=[0, -3]"], ("0.19 m from", "onboard.integral_limit_xy=")),
        (
            ["world.odometry_rate_hz=20", "cloud.compute_ms=60", "guard.command_age_max_ms=200"],
            ("holds again and again; ", "guard.command_age_max_ms="),
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


SLOW = ["guard.speed_max_mps=0.01"]


@pytest.mark.parametrize(
    ("name", "settings", "about", "told"),
    [
        ("paper", ["link.uplink.loss=1"], "1 % is 0.01", "the uplink loses 100 % of its packets: "),
        ("paper", ["link.uplink.changes=[{at_s: 3, loss: 1}]"],
         "1 % is 0.01", "100 % of its packets at times: "),
        ("paper", ["link.uplink.loss=0.4", "link.uplink.blackouts=[{start_s: 2, duration_s: 1}]"],
         "1 % is 0.01", ""),
        ("hover", ["mission.waypoints.0.dwell_s=500"],
         "dwell", "dwell times of the mission last 500 s, longer"),
        ("hover", ["mission=hover", "mission.waypoints.0.dwell_s=5"], "dwell", ""),
        ("paper", SLOW, "speed_max", "guard.speed_max_mps is 0.01 m/s, too slow for"),
        ("paper", ["cloud.controller.speed_max=0.0005"],
         "speed_max", "controller.speed_max is 0.0005 m/s"),
        ("pillars", SLOW, "speed_max", ""),
        ("steps", SLOW, "speed_max", "guard.speed_max_mps is 0.01 m/s, too slow"),
    ],
)  # fmt: skip
def test_what_lets_no_mission_succeed_is_named(name, settings, about, told):
    texts = [text for text in advise(load_experiment(name, settings)) if about in text]
    assert len(texts) == bool(told)
    assert all(told in text for text in texts)


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (
            "0,0,0,1\n5000,0,0,1\n9900,0,0,1",
            ["last 9,900 s, longer than criteria.time_limit_s"],
        ),
        ("0,0,0,1\n2,2,0,1\n3,9,0,1", ["move at 7 m/s after 2 s", "at 6 m/s"]),
        ("0,0,0,1\n2,2,0,1\n3,2,0,1", []),
    ],
)
def test_setpoints_in_milliseconds_or_faster_than_the_robot_are_named(rows, words, tmp_path):
    (tmp_path / "d.csv").write_text(f"time_s,x_m,y_m,z_m\n{rows}\n")
    settings = f"mission.setpoints={tmp_path / 'd.csv'}", "criteria.time_limit_s=60"
    text = " ".join(advise(load_experiment("hover", settings)))
    assert ("setpoints" in text) == bool(words)
    assert all(word in text for word in words)


@pytest.mark.parametrize("profile", shipped.names("profile"))
def test_each_shipped_profile_is_flown_without_a_warning(profile):
    assert list(advise(load_experiment("paper", [f"link.profile={profile}"]))) == []


@pytest.mark.parametrize(
    ("delay", "jitter", "others"),
    [
        (90, 50, {}),
        *nightly_rows((110, 20, {}), (70, 60, {}), (100, 40, {}), (120, 5, {}), (200, 150, {})),
        *nightly_rows((100, 40, {"distribution": "pareto"}), (70, 40, {"distribution": "normal"})),
    ],
)
def test_a_hold_is_announced_if_and_only_if_the_guard_holds(delay, jitter, others):
    settings = both(delay, jitter, **others)
    warned = any("guard" in text for text in advise(load_experiment("steps", settings)))
    assert warned == (numbers(fly("steps", *settings))["hold_count"] > 0)


@pytest.mark.parametrize("compute_ms", [122, 126])  # with 122, 2 ms too old between two looks
def test_a_hold_because_of_a_slow_cloud_is_announced_if_and_only_if_the_guard_holds(compute_ms):
    brief = "mission.waypoints.0.dwell_s=8", "criteria.time_limit_s=12"
    settings = "link.profile=ideal", f"cloud.compute_ms={compute_ms}", *brief
    warned = any("guard" in text for text in advise(load_experiment("hover", settings)))
    assert warned == (numbers(fly("hover", *settings))["hold_count"] > 0) == (compute_ms > 125)
