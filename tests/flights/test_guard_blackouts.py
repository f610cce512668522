"""A silent link anywhere in the paper's mission: the robot holds, then finishes the mission."""

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.messages import GuardState
from cloudrc.records import Control, GuardChange, MissionEvent
from tests.flights.conftest import (
    ANYWHERE,
    BOTH,
    COUNT,
    DAILY,
    DAILY_ANYWHERE,
    PATIENCE,
    REST,
    REST_ANYWHERE,
    SLOW,
    fly,
    fly_through,
    join,
    mid_pipe,
    numbers,
    undisturbed,
)

LONG = ("guard.hold_max_s=100",)
FEW = (13, 133)
"""Instants in the pipes that are tested in every run without the cap."""


@pytest.mark.parametrize(
    ("settings", "of_each"), [(SLOW, [47, 51, 102]), ((), [41, 48, 111])], ids=["1.5", "uncapped"]
)
def test_all_of_the_200_instants_are_in_a_pipe(settings, of_each):
    pipes = [pipe for _, pipe in mid_pipe(*settings)]
    assert len(pipes) == COUNT
    assert [pipes.count(pipe) for pipe in range(3)] == pytest.approx(of_each, abs=2)


def check_minute(figure, start_s, calm_within, *settings, where="anywhere"):
    """Both directions fall silent for a minute, as if the cloud were gone; yet it lives on.

    In test_cloud_kills.py it does not.
    """
    silence = fly_through(start_s, 60.5, *LONG, *settings)
    speed = "1.5 m/s" if settings else "uncapped"
    for name, measured, asked, unit in (
        ("HOLD after, age of the basis", silence.basis_age, 0.252, "s"),
        ("below 0.05 m/s after", silence.calm_after, calm_within, "s"),
        ("drift in 60 s", silence.drift, 0.10, "m"),
        ("in TRACK after the link's return", silence.resumed_after, 1.0, "s"),
        ("touched but the board by the tip", len(silence.touched), 0, ""),
    ):
        text = f"cloud silent for a minute {where}, {speed}: {name}"
        figure(text, measured, "<=", asked, unit)
    assert silence.outcome == "done"
    assert silence.touched == []
    # The age of the newest applied command is at the limit or up to a tick above.
    assert 0.250 < silence.basis_age <= 0.252 + 1e-9
    assert silence.held_after <= 0.252
    assert silence.calm_after <= calm_within
    assert silence.drift <= 0.10
    assert silence.resumed_after <= 1.0
    return silence


def check_minute_mid_pipe(figure, k, calm_within, *settings):
    start_s, pipe = mid_pipe(*settings)[k]
    silence = check_minute(figure, start_s, calm_within, *settings, where="mid-pipe")
    assert silence.pipe == pipe


@pytest.mark.promise("brakes-without-commands")
@pytest.mark.parametrize("k", DAILY)
def test_without_its_cloud_the_robot_stops_within_a_second(k, figure):
    check_minute_mid_pipe(figure, k, 1.0, *SLOW)


@pytest.mark.full
@pytest.mark.parametrize("k", REST)
def test_without_its_cloud_the_robot_stops_at_any_instant(k, figure):
    check_minute_mid_pipe(figure, k, 1.0, *SLOW)


@pytest.mark.parametrize("start_s", DAILY_ANYWHERE)
def test_without_its_cloud_the_robot_stops_outside_pipes_too(start_s, figure):
    assert check_minute(figure, start_s, 1.0, *SLOW).pipe == -1


@pytest.mark.full
@pytest.mark.parametrize("start_s", REST_ANYWHERE)
def test_without_its_cloud_the_robot_stops_anywhere(start_s, figure):
    check_minute(figure, start_s, 1.0, *SLOW)


def test_a_hold_of_almost_a_minute_is_resumed_as_any_other():
    silence = fly_through(ANYWHERE[71], 59.5, *SLOW)
    assert (silence.outcome, silence.touched) == ("done", [])
    assert silence.drift <= 0.10
    assert silence.resumed_after <= 1.0


def test_a_silence_at_the_missions_end_lets_the_robot_hold():
    silence = fly_through(undisturbed(*SLOW).end_ns * 1e-9 - 0.02, 60.5, *LONG, *SLOW)
    assert (silence.outcome, silence.touched) == ("done", [])
    assert 0.250 < silence.basis_age <= 0.252 + 1e-9
    assert silence.calm_after <= 1.0
    assert silence.drift <= 0.10
    assert silence.resumed_after is None


@pytest.mark.parametrize("k", FEW)
def test_without_the_cap_stopping_takes_a_little_longer(k, figure):
    check_minute_mid_pipe(figure, k, 1.4)


@pytest.mark.full
@pytest.mark.parametrize("k", [k for k in range(COUNT) if k not in FEW])
def test_without_the_cap_stopping_at_any_instant_takes_longer(k, figure):
    check_minute_mid_pipe(figure, k, 1.4)


@pytest.mark.full
@pytest.mark.parametrize("start_s", ANYWHERE)
def test_without_the_cap_stopping_anywhere_takes_longer(start_s, figure):
    check_minute(figure, start_s, 1.4)


def check_blackout(figure, start_s, duration_s, ways, *settings, clearance=0.0):
    blackouts = [
        f"link.{way}.blackouts=[{{start_s: {start_s}, duration_s: {duration_s}}}]" for way in ways
    ]
    flight = fly("paper", *PATIENCE, *blackouts, *settings)
    assert flight.verdict.failures == ()
    touched = flight.flight.recording["/contact"]
    tips = zip(touched["body"], touched["tip"], strict=True)
    assert {one for one in tips if one != ("board", True)} == set()
    least = numbers(flight)["min_clearance"]
    speed = "2 m/s" if settings else "uncapped"
    figure(f"blackout, {speed}: least clearance", least, ">=", clearance, "m")
    assert least >= clearance


WAYS = (BOTH, ("uplink",), ("downlink",))
STARTS = [round(0.5 + 1.3 * k, 2) for k in range(24)]
FAST = "cloud.controller.speed_max=2"


@pytest.mark.parametrize("ways", WAYS)
@pytest.mark.parametrize(("start_s", "duration_s"), [(11.3, 0.3), (22.1, 5.0)])
def test_a_silence_in_a_pipe_touches_nothing(start_s, duration_s, ways, figure):
    check_blackout(figure, start_s, duration_s, ways, FAST, clearance=0.12)


@pytest.mark.full
@pytest.mark.parametrize("ways", WAYS)
@pytest.mark.parametrize("duration_s", [0.3, 1.0, 5.0, 20.0])
@pytest.mark.parametrize("start_s", STARTS)
def test_a_silence_anywhere_touches_nothing(start_s, duration_s, ways, figure):
    check_blackout(figure, start_s, duration_s, ways, FAST, clearance=0.12)
    check_blackout(figure, start_s, duration_s, ways)


def fly_records(*settings, until_s=None):
    ends = join(load_experiment("paper", settings))
    of_world, of_cloud = [], []

    def sink(w, c):
        of_world.extend(w)
        of_cloud.extend(c)

    limit_ns = round((until_s or 150) * 1e9)
    over = (lambda: False) if until_s else (lambda: ends.cloud.mission_over)
    ends.run.fly(over, limit_ns, sink)
    return ends, of_world, of_cloud


def test_a_silent_downlink_freezes_until_the_echo_is_back():
    """It uses an integral and `commanded_velocity`, which would both drift."""
    _, _, of_cloud = fly_records(
        *PATIENCE,
        "cloud.predictor=commanded_velocity",
        "cloud.controller={name: pid, gain_i: [0.1, 0.1, 0.1], speed_max: 2}",
        "link.downlink.blackouts=[{start_s: 11.3, duration_s: 20}]",
    )
    control = [r for r in of_cloud if isinstance(r, Control)]
    silent = [r for r in control if 12.5e9 < r.stamp_ns < 31.3e9]
    assert len(silent) > 1800
    assert {r.command for r in silent} == {(0.0, 0.0, 0.0)}
    before = [r for r in control if 11.0e9 < r.stamp_ns < 11.3e9][-1]
    after = next(r for r in control if r.stamp_ns > 31.3e9 and any(r.command))
    assert max(abs(a - b) for a, b in zip(after.integral, before.integral, strict=True)) < 0.1
    assert [r for r in of_cloud if isinstance(r, MissionEvent)][-1].event == "done"


def test_a_lost_downlink_lands_the_robot_and_ends_the_run():
    ends, of_world, _ = fly_records(
        "link.downlink.blackouts=[{start_s: 11.3, duration_s: 1000}]", "guard.hold_max_s=20"
    )
    changes = [r for r in of_world if isinstance(r, GuardChange)]
    assert [r.state for r in changes[-3:]] == [GuardState.HOLD, GuardState.LAND, GuardState.LAND]
    assert changes[-1].cause == "touched down, rotors stopped"
    assert ends.cloud.teleop.outcome.code == "guard_stopped"
    assert ends.run.now_ns < 100e9


def test_a_robot_does_not_take_off_after_its_mission_is_over():
    """The robot receives the start but not the end of the mission."""
    ends, of_world, _ = fly_records(
        "link.downlink.blackouts=[{start_s: 0.29, duration_s: 100}]", until_s=110
    )
    changes = [r for r in of_world if isinstance(r, GuardChange)]
    assert [r.state for r in changes] == [GuardState.GROUND, GuardState.LAND]
    assert changes[-1].cause == "held for 60 s without the cloud"
    assert ends.world.robot.guard.state is GuardState.LAND


def test_a_short_hold_limit_still_waits_for_a_first_command():
    """The first command comes a round trip after the start."""
    _, of_world, _ = fly_records("link.profile=satellite", "guard.hold_max_s=0.1", until_s=4)
    changes = [r.state for r in of_world if isinstance(r, GuardChange)]
    assert changes == [GuardState.GROUND, GuardState.TRACK]


def test_a_flight_without_faults_never_meets_the_fence():
    ends, _, _ = fly_records()
    assert dict(ends.world.robot.guard.counts) == {}
