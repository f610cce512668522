"""The verdict on a mission from what teleop has seen: hand-worked cases."""

import pytest

from cloudrc.messages import GuardState
from cloudrc.teleop.verdict import Criteria, MissionObservations, judge
from cloudrc.teleop.wire import Outcome, RobotStatus

NAN = float("nan")
DONE = Outcome("done", "mission done", 2, 3)
LATE = Outcome("timed_out", "mission not done within 60 s", 1, 1)
CANCELLED = Outcome("cancelled", "mission cancelled", 1, 1)


def seen(pipe_contacts=0, touch_speed=NAN, slip_ns=0):
    return RobotStatus(
        1, (0.0, 0.0, 1.0), GuardState.TRACK, 1, "w", pipe_contacts, touch_speed, slip_ns
    )


def codes(outcome, witness, *, contact=True, elapsed=30.0):
    verdict = judge(outcome, witness, Criteria(contact, 0.25), waypoints=3, elapsed=elapsed)
    return verdict.outcome, verdict.exit_code, [failure.code for failure in verdict.failures]


@pytest.mark.parametrize(
    ("outcome", "witness", "contact", "expected"),
    [
        (DONE, MissionObservations(touch_speed=0.12), True, ("success", 0, [])),
        (DONE, MissionObservations(), False, ("success", 0, [])),
        (DONE, MissionObservations(touch_speed=9.0), False, ("success", 0, [])),
        (DONE, MissionObservations(), True, ("failure", 1, ["board_not_touched"])),
        (DONE, MissionObservations(touch_speed=0.25), True, ("failure", 1, ["contact_too_fast"])),
        (DONE, MissionObservations(pipe_touches=1), False, ("failure", 1, ["pipe_touched"])),
        (LATE, MissionObservations(), False, ("failure", 1, ["timed_out", "waypoint_not_reached"])),
        (CANCELLED, MissionObservations(), True, ("interrupted", 130, ["cancelled"])),
        (
            CANCELLED,
            MissionObservations(pipe_touches=1),
            True,
            ("interrupted", 130, ["cancelled", "pipe_touched"]),
        ),
    ],
)
def test_every_rule(outcome, witness, contact, expected):
    assert codes(outcome, witness, contact=contact) == expected


def test_slip_while_teleop_is_down_does_not_count():
    witness = MissionObservations.begin(seen(slip_ns=5)).see(seen(slip_ns=9))
    for shown in (1_000, 5_000):
        witness = witness.after_restart().see(seen(slip_ns=shown))
        assert witness.slip_ns - witness.slip_began_ns == 4
    witness = witness.see(seen(slip_ns=5_003))
    assert witness.slip_ns - witness.slip_began_ns == 7


@pytest.mark.parametrize(("slipped", "verdict"), [(1.49, "success"), (1.51, "invalid")])
def test_a_slow_world_makes_it_invalid(slipped, verdict):
    """5 % of 30 s are 1.5 s."""
    witness = MissionObservations(
        slip_began_ns=7, slip_ns=7 + round(slipped * 1e9), touch_speed=0.1
    )
    assert codes(DONE, witness)[0] == verdict


def test_only_what_happens_in_the_mission_counts():
    witness = MissionObservations.begin(seen(pipe_contacts=3, touch_speed=0.9, slip_ns=5))
    assert witness.see(seen(pipe_contacts=3, touch_speed=0.9, slip_ns=5)) is witness
    after = witness.see(seen(pipe_contacts=5, touch_speed=0.1, slip_ns=9))
    assert (after.pipe_touches, after.touch_speed) == (2, 0.1)
    assert after.slip_ns - after.slip_began_ns == 4


def test_the_first_touch_stays():
    witness = (
        MissionObservations.begin(seen()).see(seen(touch_speed=0.2)).see(seen(touch_speed=0.4))
    )
    assert witness.touch_speed == 0.2


def test_a_count_that_begins_again_is_not_negative():
    witness = MissionObservations.begin(seen(pipe_contacts=4)).see(seen(pipe_contacts=1))
    assert witness.pipe_touches == 1
