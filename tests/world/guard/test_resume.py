"""How the guard leaves HOLD without chattering between states."""

from dataclasses import replace
from itertools import pairwise
from math import dist

import pytest

from cloudrc.messages import ZERO, GuardState
from tests.world.guard.conftest import (
    DT,
    LIMITS,
    MS,
    SECOND,
    armed,
    command,
    feed,
    holding,
    run,
    tracking,
)

GROUND, TRACK, HOLD, LAND, ESTOP = GuardState


def resume(guard, start_ns, count, every_ns=10 * MS):
    feed(guard, start_ns, count, every_ns=every_ns)
    return guard.state


def test_ten_fresh_commands_within_half_a_second_end_a_hold():
    assert resume(holding(), 2 * SECOND, 9) is HOLD
    assert resume(holding(), 2 * SECOND, 10) is TRACK
    assert resume(holding(), 2 * SECOND, 10, every_ns=54 * MS) is TRACK
    assert resume(holding(), 2 * SECOND, 30, every_ns=56 * MS) is HOLD
    guard = holding()
    feed(guard, 2 * SECOND, 10)
    assert guard.take_changes()[-1].cause == "10 fresh commands within 0.090 s"


@pytest.mark.parametrize(("took_ns", "state"), [(500 * MS, TRACK), (500 * MS + 1, HOLD)])
def test_a_hold_ends_only_within_half_a_second(took_ns, state):
    guard = holding()
    for k in range(9):
        guard.accept_command(command(basis_ns=2 * SECOND + k * MS), 2 * SECOND + k * MS)
    guard.accept_command(command(basis_ns=2 * SECOND + took_ns), 2 * SECOND + took_ns)
    assert guard.state is state


def until_track(guard, start_ns):
    """Return when a stream of fresh commands from `start_ns` on ends the HOLD [ns], or None."""
    for now_ns in range(start_ns, start_ns + 3 * SECOND, 10 * MS):
        guard.accept_command(command(basis_ns=now_ns), now_ns)
        if guard.state is TRACK:
            return now_ns
    return None


def test_from_one_hold_to_the_next_it_takes_a_second():
    """Return a guard that resumed at 750 ms, with commands that stay fresh for 250 ms."""
    start_ns = 10 * SECOND
    guard = armed(now_ns=start_ns)
    feed(guard, start_ns, 300)
    guard.end_mission(start_ns + 3 * SECOND)
    guard.start_mission(start_ns + 3 * SECOND)
    assert until_track(guard, start_ns + 3 * SECOND) == start_ns + 3750 * MS


def test_from_one_track_to_the_next_it_takes_a_second():
    start_ns = 10 * SECOND
    guard = armed(now_ns=start_ns)
    feed(guard, start_ns, 1)
    guard.forget_commands()
    run(guard, start_ns + 10 * MS, start_ns + 12 * MS)
    assert guard.state is HOLD
    assert until_track(guard, start_ns + 20 * MS) == start_ns + 1000 * MS


def test_stale_commands_do_not_count():
    guard = holding()
    for k in range(30):
        assert guard.accept_command(command(basis_ns=0), 2 * SECOND + k * MS) == "stale"
    assert guard.state is HOLD


def test_commands_from_before_a_hold_do_not_count():
    guard = holding()
    feed(guard, 2 * SECOND, 9)
    guard.forget_commands()
    assert resume(guard, 2100 * MS, 9) is HOLD


def test_after_a_hold_the_reference_rises_slowly():
    guard = holding()
    now_ns = feed(guard, 2 * SECOND, 10, (1.0, 0.0, 0.0))
    start = guard.reference[0]
    feed(guard, now_ns, 10, (1.0, 0.0, 0.0))
    assert guard.reference[0] - start == pytest.approx(3.0 * 0.1)


@pytest.mark.parametrize(("speed_max", "ramp_s"), [(6.0, 2.0), (4.5, 1.5), (1.5, 1.0)])
def test_after_a_hold_the_ramp_lasts_until_the_cap(speed_max, ramp_s):
    """A first command of zero, or one that the reference reaches, does not end the ramp."""
    guard = holding(replace(LIMITS, speed_max=speed_max))
    feed(guard, 2 * SECOND, 10, ZERO)
    assert guard.state is TRACK
    ends_ns = 2 * SECOND + 90 * MS + round(ramp_s * SECOND)
    for begin_ns, rate in ((ends_ns - 20 * MS, 3.0), (ends_ns, 12.0)):
        feed(guard, begin_ns - 10 * MS, 1, ZERO)
        assert guard.reference == ZERO
        feed(guard, begin_ns, 1, (1.0, 0.0, 0.0))
        assert guard.reference[0] == pytest.approx(rate * 0.01)


def test_after_a_hold_the_return_to_the_fence_has_the_ramp():
    """The ramp limits every change of the reference, also that of the fence."""
    guard = holding()
    outside = (LIMITS.inner_corners()[1][0] + 0.15, 1.0, 2.0)
    now_ns = feed(guard, 2 * SECOND, 10, ZERO, position=outside)
    guard.reference = ZERO
    guard.counts.clear()
    flown = [ZERO, *run(guard, now_ns, now_ns + 20 * MS, outside)]
    assert guard.counts["limited_fence"] == 10
    for before, after in pairwise(flown):
        assert dist(before, after) == pytest.approx(3.0 * DT)
        assert after[0] < before[0]


def test_a_reset_to_the_ground_forgets_the_last_hold():
    guard = holding()
    now_ns = feed(guard, 2 * SECOND, 20)
    guard.put_on_ground(now_ns, "from spawn")
    guard.start_mission(now_ns)
    feed(guard, now_ns, 1, (0.0, 0.0, 1.0))
    assert guard.state is TRACK
    assert guard.reference[2] == pytest.approx(12.0 * 0.01)


def test_slowing_down_is_as_fast_as_ever_after_a_hold():
    guard = holding()
    now_ns = feed(guard, 2 * SECOND, 30, (1.0, 0.0, 0.0))
    before = guard.reference[0]
    feed(guard, now_ns, 1, (0.0, 0.0, 0.0))
    assert before - guard.reference[0] == pytest.approx(12.0 * 0.01)


def test_an_unstable_link_does_not_make_the_state_chatter():
    """Fresh commands just long enough to resume, then silence, repeatedly for 20 s."""
    guard = tracking()
    now_ns = 0
    while now_ns < 20 * SECOND:
        # The basis has the largest allowed age: each burst gives one tick of TRACK.
        for _ in range(12):
            guard.accept_command(command(basis_ns=now_ns - 249 * MS), now_ns)
            run(guard, now_ns, now_ns + 10 * MS)
            now_ns += 10 * MS
        run(guard, now_ns, now_ns + 20 * MS)
        now_ns += 20 * MS
    stamps = [change.stamp_ns for change in guard.take_changes()[1:]]
    assert len(stamps) > 20
    assert min(c - a for a, c in zip(stamps, stamps[2:], strict=False)) >= 1 * SECOND


def test_short_blackouts_are_over_within_a_second():
    for silent_ms in range(260, 1000, 20):
        guard = tracking()
        back_ns = silent_ms * MS
        run(guard, 0, back_ns)
        while guard.state is HOLD:
            back_ns = feed(guard, back_ns, 1)
        assert back_ns <= (silent_ms + 1000) * MS


def test_a_mission_from_here_leaves_hold_as_any_other():
    guard = tracking()
    guard.end_mission(10 * MS)
    run(guard, 10 * MS, 2 * SECOND)
    guard.start_mission(2 * SECOND)
    assert resume(guard, 2 * SECOND, 9) is HOLD
    assert resume(guard, 2090 * MS, 1) is TRACK
