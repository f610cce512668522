"""World and cloud as processes that stand still, or whose disk is full, in flight."""

from __future__ import annotations

import resource
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from cloudrc.record.columns import Recording
from cloudrc.record.reader import recover
from tests.drivers.conftest import Release, ages_at_hold

pytestmark = pytest.mark.process
PAGE = 4096
"""Room that is left for the recording [bytes]; the note of its end fits."""


class Recorded(Release):
    """A release whose world records."""

    def run(self, *words: str):
        more = ("--record", "world.mcap") if words[0] == "world" else ()
        return super().run(*words, *more)

    def finish(self) -> Recording:
        """Wait for the mission's end; return world's recording."""
        self.until(lambda: self.mission()["state"] == "done")
        assert [each["waypoint"] for each in self.mission()["reached"]] == [0, 1, 2]
        self.stop()
        return Recording.read(self.folder / "world.mcap")


@pytest.fixture
def release(tmp_path: Path) -> Iterator[Recorded]:
    one = Recorded(tmp_path)
    yield one
    one.end()


def freeze(release: Recorded, name: str, duration: float) -> None:
    release.running[name].send_signal(signal.SIGSTOP)
    time.sleep(duration)
    release.running[name].send_signal(signal.SIGCONT)


def test_nothing_that_a_frozen_cloud_computed_before_is_flown(release: Recorded) -> None:
    release.fly()
    freeze(release, "cloud", 3.0)
    flown = release.finish()
    ages = ages_at_hold(flown)
    assert len(ages) == 1
    assert 0.25 < ages[0] <= 0.252 + 1e-9
    applied = flown["/command_applied"]
    assert (applied["stamp_ns"] - applied["basis_stamp_ns"]).max() <= 252_000_000


@pytest.mark.full
def test_a_frozen_world_skips_no_tick_and_slips(release: Recorded) -> None:
    release.fly()
    freeze(release, "world", 0.2)
    flown = release.finish()
    assert (np.diff(flown["/ground_truth"]["stamp_ns"]) == 10_000_000).all()
    applied = flown["/command_applied"]
    order = list(zip(applied["epoch"].tolist(), applied["counter"].tolist(), strict=True))
    assert order == sorted(set(order))
    assert flown["/lateness"]["slip_ns"][-1] >= 130_000_000


@pytest.mark.full
def test_a_full_disk_ends_the_recording_and_not_the_flight(release: Recorded) -> None:
    release.fly()
    path, world = release.folder / "world.mcap", release.running["world"]
    room = path.stat().st_size + PAGE
    resource.prlimit(world.pid, resource.RLIMIT_FSIZE, (room, room))
    flown = release.finish()
    assert "recording stopped" in flown.note
    assert recover(path, release.folder / "mended.mcap").bytes_lost == 0
