"""The last mission is cut from a recording that is still open, with a mark if it is complete."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.record.merge import Mission, cut_to_last_mission, merge
from cloudrc.record.writer import McapWriter
from cloudrc.records import Record
from cloudrc.report.document import Run
from cloudrc.report.write import assess
from tests.flights.conftest import records

SECOND = 1_000_000_000
HOVER = ("hover", ("mission.waypoints.0.dwell_s=1.0",))


@cache
def flown() -> tuple[list[Record], list[Record]]:
    return records(load_experiment(*HOVER))


def later(given: list[Record], by_ns: int) -> list[Record]:
    return [record._replace(stamp_ns=record.stamp_ns + by_ns) for record in given]


def merged(folder: Path, *flights: tuple[list[Record], list[Record]], torn: bool) -> Mission:
    """Record flights as two pods do; torn: the files have no end, as when copied in flight."""
    for number, end in enumerate(("world", "cloud")):
        path = folder / f"{end}.mcap"
        with McapWriter(path, clock=end, clock_id="same") as writer:
            for flight in flights:
                writer.write(flight[number])
            writer.flush()
            size = path.stat().st_size
        if torn:
            with path.open("r+b") as file:
                file.truncate(size)
    return merge(folder / "world.mcap", folder / "cloud.mcap")


@pytest.mark.parametrize("torn", [True, False])
def test_a_recording_with_the_missions_end_is_complete(tmp_path: Path, torn: bool) -> None:
    world, cloud = flown()
    mission = merged(tmp_path, flown(), (later(world[-300:], SECOND), []), torn=torn)
    assert bool(mission.contents.note) == torn
    cut, ended = cut_to_last_mission(mission)
    assert ended
    assert cut.recording().complete
    assert cloud


def test_a_recording_without_the_missions_end_is_incomplete(tmp_path: Path) -> None:
    world, cloud = flown()
    mission = merged(tmp_path, (world[: len(world) // 2], cloud[: len(cloud) // 2]), torn=True)
    cut, ended = cut_to_last_mission(mission)
    assert not ended
    assert not cut.recording().complete


def test_only_the_last_of_two_missions_is_kept(tmp_path: Path) -> None:
    world, cloud = flown()
    gap = world[-1].stamp_ns + 5 * SECOND
    second = later(world, gap), later(cloud, gap)
    after = later(world[-300:], gap + SECOND), []
    cut, ended = cut_to_last_mission(merged(tmp_path, flown(), second, after, torn=True))
    assert ended
    alone, _ = cut_to_last_mission(merged(tmp_path, second, after, torn=True))
    experiment = load_experiment(*HOVER)
    both = [assess(m.recording(), experiment, Run("virtual", "virtual")) for m in (cut, alone)]
    assert both[0].verdict.outcome == "success"
    assert both[0].numbers["duration"] == both[1].numbers["duration"]
    first = int(cut.recording()["/mission"]["stamp_ns"][0])
    assert first > gap


def test_a_mission_that_a_new_pod_resumed_is_kept_as_a_whole(tmp_path: Path) -> None:
    """The mission's start was in the old pod's recording, which is lost."""
    world, cloud = flown()
    half = cloud[len(cloud) // 3 :]
    after = later(world[-300:], SECOND), []
    cut, ended = cut_to_last_mission(merged(tmp_path, (world, half), after, torn=True))
    assert ended
    assert cut.contents.messages[0][1] <= world[0].stamp_ns + SECOND
