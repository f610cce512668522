"""Teleop and cloud end at the same time, and teleop's hold still reaches the robot."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from cloudrc.drivers.teleop import LAST_WORD_NS, LastWord
from tests.drivers.conftest import Release

SECOND = 1_000_000_000


class Cloud:
    """The inputs of `LastWord`, with a clock that a test moves."""

    def __init__(self) -> None:
        self.asked = self.flies = False
        self.now_ns = SECOND
        self.ends = LastWord(lambda: self.asked, lambda: self.flies, lambda: self.now_ns)


@pytest.mark.parametrize("flies", [False, True])
def test_who_is_not_asked_goes_on(flies: bool) -> None:
    cloud = Cloud()
    cloud.flies = flies
    for _ in range(3):
        cloud.now_ns += SECOND
        assert not cloud.ends()


def test_with_nothing_in_flight_it_ends_at_once() -> None:
    cloud = Cloud()
    cloud.asked = True
    assert cloud.ends()


def test_what_flies_is_waited_for_until_it_is_seen_to_hold() -> None:
    cloud = Cloud()
    cloud.asked = cloud.flies = True
    assert not cloud.ends()
    cloud.now_ns += LAST_WORD_NS - 1
    assert not cloud.ends()
    cloud.flies = False
    assert cloud.ends()


def test_the_delay_ends_at_its_limit_after_the_request() -> None:
    cloud = Cloud()
    cloud.flies = True
    assert not cloud.ends()
    cloud.now_ns += 10 * SECOND
    cloud.asked = True
    assert not cloud.ends()
    cloud.now_ns += LAST_WORD_NS
    assert cloud.ends()


@pytest.fixture
def release(tmp_path: Path) -> Iterator[Release]:
    one = Release(tmp_path)
    yield one
    one.end()


@pytest.mark.process
def test_a_pod_that_ends_in_flight_holds_the_robot_by_its_word(release: Release) -> None:
    """Cloud gets the signal first, when teleop has not sent its hold yet."""
    release.fly()
    pod, began = ("cloud", "teleop"), time.monotonic()
    for name in pod:
        release.running[name].send_signal(signal.SIGTERM)
    for name in pod:
        release.running[name].communicate(timeout=10)
    assert time.monotonic() - began < 2.0
    assert [release.running[name].returncode for name in pod] == [0, 0]
    time.sleep(0.5)  # without commands the robot also holds, after 0.25 s
    world = release.running["world"]
    asked = time.monotonic()
    world.send_signal(signal.SIGTERM)
    said, _ = world.communicate(timeout=10)
    assert [line for line in said.splitlines() if "HOLD" in line] == ["guard: HOLD, mission ended"]
    assert time.monotonic() - asked < 2.0
