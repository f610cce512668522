# SPDX-License-Identifier: Apache-2.0

"""The missions and their required numbers, in virtual time; `-m full` flies more seeds."""

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.schema import MissionConfig
from cloudrc.flight.assembly.plan import build_plan
from tests.conftest import nightly
from tests.flights.conftest import fly, numbers

pytestmark = pytest.mark.usefixtures("shared_files")


@pytest.mark.parametrize("profile", ["paper-p2", "paper-p3", *nightly("paper-p1")])
@pytest.mark.parametrize("seed", [1, *nightly(*range(2, 11))])
def test_the_paper_flies(profile, seed):
    flight = fly("paper", f"link.profile={profile}", f"seed={seed}")
    assert flight.verdict.failures == ()
    n = numbers(flight)
    # 28 s, and 0.1 s for estimates without bias: a longer horizon damps the approach.
    assert n["contact_time"] - n["start_delay"] <= 28.1
    assert n["min_clearance"] >= 0.14
    assert n["touch_speed"] <= 0.15
    assert 0.1 <= n["steady_contact_force"] <= 0.5
    assert n["hold_count"] == 0
    assert n["waypoints_reached"] == 7


def test_verbatim_flies_although_late_commands_win():
    flight = fly("paper-verbatim")
    assert flight.verdict.failures == ()
    newest = fly("paper", "link.profile=paper-p2", "seed=1")
    assert numbers(flight)["loop_delay_mean"] > numbers(newest)["loop_delay_mean"]


@pytest.mark.parametrize(
    "setting",
    [
        *(f"link.profile={n}" for n in ("handover", "lossy", "satellite")),
        *nightly(*(f"link.profile={n}" for n in ("ideal", "wifi", "lte", "5g"))),
        "world.sensors={position_noise_m: 0.005, velocity_noise_mps: 0.02}",
    ],
)
def test_the_paper_flies_under_other_conditions_too(setting):
    assert fly("paper", setting).verdict.failures == ()


def test_the_limit_of_a_leg_defaults_to_three_times_its_time():
    points = [{"position_m": (0.0, 0.0, 1.0)}, {"position_m": (3.0, 4.0, 1.0), "dwell_s": 2.0}]
    points.append({**points[1], "time_limit_s": 7.5})
    mission = MissionConfig.model_validate({"start": "here", "waypoints": tuple(points)})
    for speed, second in ((6, 33.0), (0.5, 48.0)):
        flown = load_experiment("hover", [f"guard.speed_max_mps={speed}"])
        plan = build_plan(flown, mission)
        limits = [leg.time_limit for leg in plan.legs]
        assert limits[1:] == [second, 7.5]
        assert plan.time_limit == max(60.0, sum(limits))


def test_a_long_mission_needs_no_time_limit_of_its_own():
    flight = fly("hover", "mission.waypoints.0.dwell_s=60", "criteria={settle_m: 0.15}")
    assert flight.verdict.failures == ()
    steps = load_experiment("steps", ["mission.steps.count=20"])
    assert build_plan(steps).time_limit > 20 * 4.25
