"""The paper's mission and its required numbers, in virtual time; `-m full` flies more seeds."""

import pytest

from tests.flights.conftest import fly, numbers

PROFILES = ("paper-p1", "paper-p2", "paper-p3")


def check(profile, seed):
    flight = fly("paper", f"link.profile={profile}", f"seed={seed}")
    assert flight.verdict.failures == ()
    n = numbers(flight)
    assert n["contact_time"] <= 28.0
    assert n["min_clearance"] >= 0.14
    assert n["tip_speed"] <= 0.15
    assert 0.1 <= n["steady_contact_force"] <= 0.5
    assert n["hold_count"] == 0
    assert n["waypoints_reached"] == 7


@pytest.mark.parametrize("profile", PROFILES)
def test_the_paper_flies(profile):
    check(profile, seed=1)


@pytest.mark.full
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("seed", range(1, 11))
def test_the_paper_flies_thirty_times(profile, seed):
    check(profile, seed)


def check_silence(start_s):
    flight = fly(
        "paper",
        "cloud.controller.speed_max=2",
        f"link.downlink.blackouts=[{{start_s: {start_s}, duration_s: 20}}]",
    )
    assert flight.verdict.failures == ()
    n = numbers(flight)
    assert n["hold_count"] == 1
    assert n["pipe_contacts"] == 0
    assert n["waypoints_reached"] == 7


# In pipe 1 at speed, at the second bend, and just before the board is touched.
@pytest.mark.parametrize("start_s", [11.3, 22.1, 28.85])
def test_a_silent_downlink_is_survived(start_s):
    check_silence(start_s)


@pytest.mark.full
@pytest.mark.parametrize("start_s", [round(0.5 + 1.3 * k, 2) for k in range(24)])
def test_a_silent_downlink_is_survived_at_any_instant(start_s):
    check_silence(start_s)


def test_verbatim_flies_although_late_commands_win():
    flight = fly("paper-verbatim")
    assert flight.verdict.failures == ()
    assert numbers(flight)["loop_delay_mean"] > numbers(fly("paper"))["loop_delay_mean"]


@pytest.mark.parametrize(
    "profile", ["ideal", "wifi", "lte", "5g", "handover", "lossy", "satellite"]
)
def test_every_other_profile_flies_too(profile):
    flight = fly("paper", f"link.profile={profile}")
    assert flight.verdict.failures == ()


def test_the_paper_flies_with_noisy_odometry():
    noise = "world.sensors={position_noise_m: 0.005, velocity_noise_mps: 0.02}"
    assert fly("paper", noise).verdict.failures == ()
