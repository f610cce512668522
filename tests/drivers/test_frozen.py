"""World as a process that stands still, or whose disk is full, in flight."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cloudrc.record.columns import Recording
from cloudrc.record.recover import recover
from tests.drivers.conftest import Release

pytestmark = [pytest.mark.process, pytest.mark.full]
PAGE = 4096
"""Room that is left for the recording [bytes]; the note of its end fits."""


def finish(release: Release) -> Recording:
    """Wait for the mission's end; return world's recording."""
    release.until(lambda: release.mission()["state"] == "done")
    assert [each["waypoint"] for each in release.mission()["reached"]] == [0, 1, 2]
    release.stop()
    return Recording.read(release.folder / "world.mcap")


@pytest.fixture
def release(tmp_path: Path) -> Iterator[Release]:
    one = Release(tmp_path, "world")
    yield one
    one.end()


def test_a_frozen_world_skips_no_tick_and_slips(release: Release) -> None:
    release.fly()
    release.freeze("world", 0.2)
    flown = finish(release)
    assert (np.diff(flown["/ground_truth"]["stamp_ns"]) == 10_000_000).all()
    applied = flown["/command_applied"]
    order = list(zip(applied["epoch"].tolist(), applied["counter"].tolist(), strict=True))
    assert order == sorted(set(order))
    assert flown["/lateness"]["slip_ns"][-1] >= 130_000_000


def test_a_full_disk_ends_the_recording_and_not_the_flight(release: Release) -> None:
    release.fly()
    path, world = release.folder / "world.mcap", release.running["world"]
    room = path.stat().st_size + PAGE
    resource.prlimit(world.pid, resource.RLIMIT_FSIZE, (room, room))
    flown = finish(release)
    assert "recording stopped" in flown.note
    assert recover(path, release.folder / "mended.mcap").bytes_lost == 0
