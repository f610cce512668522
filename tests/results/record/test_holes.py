# SPDX-License-Identifier: Apache-2.0

"""A recording knows the times in which its messages are lost, and every copy of it knows them."""

import pytest
from mcap.reader import make_reader

from cloudrc.base.errors import BadInputError
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.holes import END_NS, SOMEWHERE, Hole
from cloudrc.results.record.merge import cut_to_last_mission, merge
from cloudrc.results.record.writer import McapWriter
from cloudrc.results.report.folder import open_recording
from cloudrc.wire.records import Counted, MissionEvent
from tests.results.record.conftest import MS, SECOND, cloud_records, copied, world_records, write

RECORDS = world_records(200)  # four chunks


def without(path, chunks, index=True):
    """Damage chunks of a file; without `index`, also take its end away."""
    with path.open("rb") as file:
        found = make_reader(file).get_summary().chunk_indexes
    data = bytearray(path.read_bytes())
    for number in chunks:
        data[found[number].chunk_start_offset + found[number].chunk_length // 2] ^= 16
    last = found[-1].chunk_start_offset + found[-1].chunk_length
    path.write_bytes(data if index else data[:last])
    return path


@pytest.fixture
def path(tmp_path):
    return write(tmp_path / "x.mcap", RECORDS)


def test_an_intact_recording_has_no_hole_and_one_that_ends_in_its_views_lacks_the_rest(tmp_path):
    path = tmp_path / "x.mcap"
    with McapWriter(path, clock="world") as writer:
        writer.write(RECORDS)
        writer.write_views([("/tf", n * 10 * MS, bytes(100)) for n in range(40)])
    assert Recording.read(path).holes == ()
    assert Recording.read(without(path, [4])).holes == (Hole(RECORDS[-1].stamp_ns, END_NS),)


def test_a_merged_recording_has_the_holes_of_both_ends_on_worlds_clock(tmp_path):
    ahead = 3 * SECOND
    world = write(tmp_path / "world.mcap", world_records(200, 2 * ahead))
    cloud = write(tmp_path / "cloud.mcap", cloud_records(200, ahead), "cloud")
    without(cloud, [1])
    (there,), (here,) = Recording.read(cloud).holes, merge(world, cloud).holes
    offset_ns = int(merge(world, cloud).metadata["clock_offset_ns"])
    assert here == Hole(there.begin_ns + offset_ns, END_NS)
    cloud.write_bytes(b"")
    assert merge(world, cloud).holes == (SOMEWHERE,)


@pytest.mark.parametrize(("count", "whole"), [(200, True), (100, False)])
def test_a_mission_is_whole_if_both_files_contain_its_end(tmp_path, count, whole):
    world = write(tmp_path / "world.mcap", world_records(count), clock_id="a")
    cloud = write(tmp_path / "cloud.mcap", cloud_records(150), "cloud", "a")
    without(world, [], index=False)
    mission = merge(world, cloud)
    assert cut_to_last_mission(mission, being_written=True) == whole
    assert (mission.note == "") == (mission.holes == ()) == whole


@pytest.mark.parametrize(("ended", "is_whole"), [(2, True), (5, False), (None, False)])
def test_the_last_mission_of_a_killed_session_and_of_its_copy_are_whole_alike(
    tmp_path, ended, is_whole
):
    """The recording of a mission goes on for 2 s after its end; this session has 6 s."""
    records = [Counted(n * 10 * MS, "cloud", "sent", n) for n in range(600)]
    events = [(1, "started")] + [(ended, "done")] * (ended is not None)
    records += [MissionEvent(at * SECOND, word, 0, "") for at, word in events]
    records.sort(key=lambda record: record.stamp_ns)
    session = without(write(tmp_path / "session.mcap", records), [], index=False)
    for mission in (Recording.read(session), copied(session)):
        cut_to_last_mission(mission)
        mission.write(target := tmp_path / "mission.mcap")
        for each in (mission, Recording.read(target)):
            assert (each.note == "") == (each.holes == ()) == is_whole


def test_a_damaged_file_is_refused_where_a_whole_one_is_needed(path):
    with pytest.raises(
        BadInputError, match=r"damaged at byte .*cloudrc report .*x\.mcap --recover$"
    ):
        open_recording(without(path, [1]))
