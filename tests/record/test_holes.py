"""A recording knows the times in which its messages are lost, and every copy of it knows them."""

import json

import pytest
from mcap.reader import make_reader

from cloudrc.errors import BadInputError
from cloudrc.record.columns import Recording
from cloudrc.record.holes import END_NS, HOLES, SOMEWHERE, Hole, describe, of_metadata, union
from cloudrc.record.merge import cut_to_last_mission, merge
from cloudrc.record.recovery import recover
from cloudrc.record.topics import VIEWS
from cloudrc.record.writer import CHUNK_NS, COUNTS, McapWriter
from cloudrc.records import Counted, MissionEvent
from cloudrc.runs.identify import identify
from cloudrc.runs.links.trace import LogSettings, read_packets
from cloudrc.runs.replay import write_replay
from tests.record.conftest import MS, SECOND, cloud_records, rewrite, world_records, write

RECORDS = world_records(200)  # four chunks
READERS = [
    lambda path: read_packets(path, LogSettings()),
    identify,
    lambda path: write_replay(path, path.with_name("page.html")),
]
HOLE = Hole(CHUNK_NS - 6 * MS, 2 * CHUNK_NS)


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


@pytest.fixture
def damaged(path):
    return without(path, [1])


def copy(path):
    recover(path, target := path.with_suffix(".copy.mcap"))
    return Recording.read(target)


@pytest.mark.parametrize(
    ("chunks", "index", "holes"),
    [
        ([1], True, [HOLE]),
        ([1, 2], True, [Hole(HOLE.begin_ns, 3 * CHUNK_NS)]),
        ([0], True, [Hole(0, CHUNK_NS)]),
        ([3], True, [Hole(3 * CHUNK_NS - 6 * MS, END_NS)]),
        ([1], False, [HOLE, Hole(RECORDS[-1].stamp_ns, END_NS)]),
    ],
)
def test_a_damaged_chunk_leaves_a_hole_that_each_copy_keeps(path, chunks, index, holes):
    without(path, chunks, index)
    assert list(Recording.read(path).holes) == holes
    assert list(copy(path).holes) == holes
    assert list(copy(path.with_suffix(".copy.mcap")).holes) == holes


def test_an_intact_recording_and_one_with_damaged_views_have_no_hole(tmp_path):
    path = tmp_path / "x.mcap"
    with McapWriter(path, clock="world") as writer:
        writer.write(RECORDS)
        writer.write_views([("/tf", n * 10 * MS, bytes(100)) for n in range(40)])
    assert Recording.read(path).holes == ()
    found = Recording.read(without(path, [4]))
    assert ("damaged" in found.lacking, found.holes) == (True, ())


@pytest.mark.parametrize("index", [True, False])
@pytest.mark.parametrize("chunk", [1, 4])
def test_damaged_views_are_made_again_and_counted_if_all_other_messages_are_there(
    path, chunk, index
):
    """Chunks 4 and 5 have views only; chunk 1 has none."""
    views = [("/tf", n * 10 * MS, bytes(100)) for n in range(100)]
    with McapWriter(path, clock="world") as writer:
        writer.write(RECORDS)
        writer.attach("config.yaml", b"")
        writer.write_views(views)
    without(path, [chunk])
    if not index:
        path.write_bytes(path.read_bytes()[:-100] + bytes(100))
    recovery = recover(path, path.with_name("copy.mcap"), lambda recording: views[5:])
    assert recovery.derived == ["/tf"]
    lost = {topic: n for topic, n in recovery.dropped.items() if topic in VIEWS}
    if index:
        assert lost == {"/tf": 5}
    else:
        assert lost == ({} if chunk == 4 else dict.fromkeys(VIEWS))


def test_nobody_knows_when_messages_were_that_another_program_removed(path, tmp_path):
    other = rewrite(path, tmp_path / "y.mcap", keep=lambda c, m: c.topic != "/contact")
    assert Recording.read(other).holes == copy(other).holes == (SOMEWHERE,)


def test_messages_whose_topic_is_lost_leave_a_hole(tmp_path):
    """The first chunk defines the topics but /count, and no index repeats them."""
    records = [record for record in RECORDS if not isinstance(record, Counted)]
    records.insert(len(records) // 2, Counted(SECOND, "world", "sent", 1))
    path = without(write(tmp_path / "x.mcap", records), [0], index=False)
    holes = copy(path).holes
    assert any(hole.begin_ns <= CHUNK_NS and hole.end_ns > RECORDS[-1].stamp_ns for hole in holes)


def test_views_whose_topic_is_lost_leave_a_hole_behind_all_other_messages_only(path):
    """The views are behind all messages, and their topic is defined in their first chunk."""
    with McapWriter(path, clock="world") as writer:
        writer.write(RECORDS)
        writer.write_views([("/tf", n * 10 * MS, bytes(100)) for n in range(100)])
    assert copy(without(path, [4], index=False)).holes == (Hole(RECORDS[-1].stamp_ns, END_NS),)


def test_a_copy_that_was_torn_again_is_counted_by_its_own_writer(path):
    """The counts of the file that it was copied from prove nothing."""
    whole = Recording.read(path)
    whole.metadata[COUNTS] = '{"/odometry": 1}'
    whole.write(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    found = Recording.read(path)
    assert found.holes == (Hole(found.messages[-1][1], END_NS),)


@pytest.mark.parametrize("are_zeros", [False, True])
def test_a_torn_recording_has_lost_its_end(path, are_zeros):
    """After a power loss, a file may have its full length and zeros at its end."""
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[: size // 2] + bytes(are_zeros * (size - size // 2)))
    found = Recording.read(path)
    assert found.holes == (Hole(found.messages[-1][1], END_NS),) == copy(path).holes


@pytest.mark.parametrize("noted", ["[[1]]", "[[5, 1]]", '["a", 3]', "{", "3", "[[1.5, 2]]"])
def test_strange_holes_in_the_metadata_are_holes_somewhere(noted):
    assert of_metadata({HOLES: noted}) == (SOMEWHERE,)
    assert of_metadata({HOLES: json.dumps([HOLE])}) == (HOLE,)


def test_a_merged_recording_has_the_holes_of_both_ends_on_worlds_clock(tmp_path):
    ahead = 3 * SECOND
    world = write(tmp_path / "world.mcap", world_records(200, 2 * ahead))
    cloud = write(tmp_path / "cloud.mcap", cloud_records(200, ahead), "cloud")
    without(cloud, [1])
    (there,), (here,) = Recording.read(cloud).holes, merge(world, cloud).holes
    offset_ns = int(merge(world, cloud).metadata["clock_offset_ns"])
    assert here == Hole(there.begin_ns + offset_ns, there.end_ns + offset_ns)
    cloud.write_bytes(b"")
    assert merge(world, cloud).holes == (SOMEWHERE,)


@pytest.mark.parametrize(("count", "whole"), [(200, True), (100, False)])
def test_a_mission_is_whole_if_both_files_contain_its_end(tmp_path, count, whole):
    world = write(tmp_path / "world.mcap", world_records(count), clock_id="a")
    cloud = write(tmp_path / "cloud.mcap", cloud_records(150), "cloud", "a")
    without(world, [], index=False)
    mission = merge(world, cloud)
    assert cut_to_last_mission(mission, being_written=True) == whole
    assert (mission.torn == "", mission.holes == ()) == (whole, whole)


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
    for mission in (Recording.read(session), copy(session)):
        cut_to_last_mission(mission)
        mission.write(target := tmp_path / "mission.mcap")
        for each in (mission, Recording.read(target)):
            assert (each.note == "", each.holes == ()) == (is_whole, is_whole)


@pytest.mark.parametrize("read", READERS)
def test_every_reader_refuses_a_damaged_file_and_names_the_remedy(damaged, read):
    with pytest.raises(BadInputError, match=r"damaged at byte .*cloudrc recover .*x\.mcap$"):
        read(damaged)


@pytest.mark.parametrize("read", READERS)
def test_every_reader_refuses_a_torn_file_and_names_the_remedy(path, read):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(BadInputError, match=r"cut short: .*cloudrc recover .*x\.mcap$"):
        read(path)


def test_holes_that_overlap_are_one_hole():
    """A commanded phase must not begin behind one hole and inside of another."""
    assert union([Hole(5, 9), Hole(0, 3), Hole(1, 4), Hole(0, 2), Hole(4, 4)]) == (
        Hole(0, 4),
        Hole(4, 4),
        Hole(5, 9),
    )
    assert union([Hole(5, 9), SOMEWHERE]) == (SOMEWHERE,)


def test_holes_of_both_ends_that_overlap_are_one_hole(tmp_path):
    for end, records, chunks in (
        ("world", world_records(200), [1, 2]),
        ("cloud", cloud_records(200), [2]),
    ):
        without(write(tmp_path / f"{end}.mcap", records, end, "a"), chunks)
    (hole,) = merge(tmp_path / "world.mcap", tmp_path / "cloud.mcap").holes
    assert hole.begin_ns < 2 * CHUNK_NS
    assert hole.end_ns >= 3 * CHUNK_NS


def test_holes_are_described_in_words():
    holes = [Hole(0, SECOND), Hole(2 * SECOND, 3 * SECOND), Hole(4 * SECOND, END_NS)]
    said = describe([*holes, *holes], lambda ns: ns * 1e-9)
    assert said == "all lost up to 1.00 s, 1.00 s lost at 2.00 s, all lost from 4.00 s on"
    assert "nobody knows when" in describe([SOMEWHERE], float)
    assert describe([], float) == ""
