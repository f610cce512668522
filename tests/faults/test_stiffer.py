"""The fence holds under the low-level controller that studies of the steady error fly, too."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import pytest

from cloudrc.faults import fuzz
from cloudrc.faults.adversary import choose
from cloudrc.faults.flight import Flight

STIFFER = "world.low_level.integral_limit_xy=0.30"
"""Three times as much as shipped: what takes the steady error of 32 mm away."""


def fly(seeds: Iterable[int], *settings: str) -> tuple[int, list[str]]:
    """Fly the clouds of some seeds that are hostile amid no other fault; how many, what broke."""
    schedules = [each for each in map(choose, seeds) if not each.events]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fuzz, "Flight", lambda *of, **more: Flight(*of, *settings, **more))
        return len(schedules), [str(b) for each in schedules for b in fuzz.fly(each).breaches]


@pytest.mark.promise("stays-inside-the-fence")
def test_a_hostile_cloud_keeps_a_stiffer_robot_in_the_fence() -> None:
    flown, broken = fly(range(1, 7), STIFFER)
    assert flown > 1
    assert broken == []


def test_a_setting_reaches_the_flight() -> None:
    """And beyond what README shows, the fence does not hold: the guard counts on a tamer robot."""
    _, broken = fly([70001], "world.low_level.integral_limit_xy=1000")
    assert any("fence" in each for each in broken)


@pytest.mark.full
@pytest.mark.parametrize("part", range(20))
def test_two_hundred_do_not_either(part: int, figure: Callable[..., Any]) -> None:
    flown, broken = fly(range(7 + 22 * part, 29 + 22 * part), STIFFER)
    figure(f"hostile clouds, {STIFFER}: breaches", len(broken), "==", 0, count=flown)
