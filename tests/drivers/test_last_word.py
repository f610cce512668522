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


def test_what_flies_is_waited_for_until_it_holds_or_for_its_limit() -> None:
    asked, flies, now_ns = [False], [True], [SECOND]
    ends = LastWord(lambda: asked[0], lambda: flies[0], lambda: now_ns[0])
    for now_ns[0] in (SECOND, 10 * SECOND):
        assert not ends(), "nobody has asked"
    asked[0] = True
    assert not ends()
    now_ns[0] += LAST_WORD_NS - 1
    assert not ends()
    flies[0] = False
    assert ends(), "it holds"
    flies[0] = True
    now_ns[0] += 1
    assert ends(), "too late"


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
    world.send_signal(signal.SIGTERM)
    said, _ = world.communicate(timeout=10)
    assert [line for line in said.splitlines() if "HOLD" in line] == ["guard: HOLD, mission ended"]
