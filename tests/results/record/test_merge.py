# SPDX-License-Identifier: Apache-2.0

"""The recordings of world and cloud are merged on world's clock, with the offset's uncertainty."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.base.errors import BadInputError
from cloudrc.results.record import part_before
from cloudrc.results.record.columns import Recording
from cloudrc.results.record.merge import (
    clock_offset,
    cut_to_last_mission,
    machine_time_ns,
    merge,
    world_time_ns,
)
from cloudrc.results.record.writer import McapWriter
from cloudrc.wire import records as rec
from tests.results.record.conftest import (
    MS,
    SECOND,
    assert_equal,
    cloud_records,
    later,
    world_records,
    write,
)


def files(folder, world, cloud, ids):
    return (
        write(folder / "world.mcap", world, "world", ids[0]),
        write(folder / "cloud.mcap", cloud, "cloud", ids[1]),
    )


def merged(folder):
    """Merge the files of both ends; return the recording, and the one that its file has."""
    mission = merge(folder / "world.mcap", folder / "cloud.mcap")
    mission.write(folder / "mission.mcap")
    return mission, Recording.read(folder / "mission.mcap")


@pytest.mark.parametrize(("start", "ahead"), [(9 * SECOND, 5 * SECOND), (0, -SECOND)])
def test_two_clocks_are_related_by_the_packets(tmp_path, start, ahead):
    """With delays of 40 ms up and 30 ms down, the estimate is wrong by 5 ms; its bound is 35 ms.

    In the last case cloud's first stamps become negative, but MCAP has no negative log times.
    """
    world, cloud = world_records(60, start), cloud_records(60, start - ahead)
    files(tmp_path, world, cloud, ("", ""))
    mission, recording = merged(tmp_path)
    assert recording.note == ""
    noted = {
        "clock": "world",
        "clock_offset_ns": str(ahead - 5 * MS),
        "clock_offset_uncertainty_ns": str(35 * MS),
        "clock_offset_method": "packets",
    }
    assert noted.items() <= recording.metadata.items()
    assert_equal(recording, Recording.from_records(world, later(cloud, ahead - 5 * MS)))
    assert_equal(recording, mission)
    assert recording.sha256 == mission.sha256


@given(
    st.integers(-(10**12), 10**12),
    st.lists(st.tuples(st.integers(0, 10**9), st.integers(0, 10**9)), min_size=1, max_size=20),
)
@settings(max_examples=30, deadline=None)
def test_the_true_offset_is_within_the_uncertainty(ahead, delays):
    """World's clock is `ahead` of cloud's; the fastest packet may come later."""
    telemetry, control = world_records(1)[2], cloud_records(1)[1]
    world, cloud = [], []
    for n, (up, down) in enumerate(delays):
        sent = n * 10 * MS  # on cloud's clock
        world.append(telemetry._replace(stamp_ns=sent + ahead, counter=n))
        cloud.append(rec.Arrival(sent + up, True, 1, n, 0.0, True))
        cloud.append(control._replace(stamp_ns=sent, counter=n))
        world.append(rec.Arrival(sent + down + ahead, False, 1, n, 0.0, True))
    found = clock_offset(Recording.from_records(world), Recording.from_records([], cloud))
    assert found.method == "packets"
    assert abs(found.offset_ns - ahead) <= found.uncertainty_ns
    smallest = min(up for up, _ in delays) + min(down for _, down in delays)
    assert found.uncertainty_ns == (smallest + 1) // 2


def test_the_same_clock_is_left_as_it_is(tmp_path):
    ends = {"world": world_records(20), "cloud": cloud_records(20)}
    for end, records in ends.items():
        with McapWriter(tmp_path / f"{end}.mcap", clock=end, clock_id="boot") as writer:
            writer.write(records)
            writer.note({"missing": "once"})
            writer.note({"missing": f"by {end}"})
            writer.attach(f"{end}.txt", end.encode())
            writer.attach("config.yaml", end.encode())
    mission = merge(tmp_path / "world.mcap", tmp_path / "cloud.mcap")
    assert mission.told == "world: by world; cloud: by cloud"
    assert mission.metadata["clock_offset_method"] == "same clock"
    mission.write(tmp_path / "mission.mcap", {"report.json": b"{}"})
    merged = Recording.read(tmp_path / "mission.mcap")
    assert_equal(merged, Recording.from_records(*ends.values()))
    texts = {"world.txt": b"world", "cloud.txt": b"cloud", "config.yaml": b"world"}
    assert merged.attachments == texts | {"report.json": b"{}"}


@pytest.mark.parametrize(("clock", "torn", "rows"), [("a", 1, 80), ("b", 1, 50), ("a", 4, 50)])
def test_a_complete_part_before_on_the_same_clock_belongs_to_a_recording(
    tmp_path, clock, torn, rows
):
    world, cloud = files(tmp_path, world_records(50, SECOND), cloud_records(50, SECOND), ("a", "a"))
    part = write(part_before(world), world_records(30), "world", clock)
    part.write_bytes(part.read_bytes()[: part.stat().st_size // torn])
    mission = merge(world, cloud)
    assert (len(mission["/odometry"]), mission.note) == (rows, "")
    assert len(merge(world, cloud, last_ns=400 * MS)["/odometry"]) == 50
    part.write_bytes(world.read_bytes())  # copied while a recorder began anew
    assert len(merge(world, cloud)["/odometry"]) == 50


def test_of_a_process_that_a_fault_killed_the_last_records_are_a_hole(tmp_path):
    ends = files(tmp_path, world_records(50, SECOND), cloud_records(50, SECOND), ("a", "a"))
    part = write(part_before(ends[0]), world_records(30), "world", "a")
    part.write_bytes(part.read_bytes()[: part.stat().st_size * 2 // 5])
    assert len(merge(*ends)["/odometry"]) == 50
    mission = merge(*ends, killed=True)
    assert len(mission["/odometry"]) == 80
    mission.write(tmp_path / "mission.mcap", {})
    (hole,) = Recording.read(tmp_path / "mission.mcap").holes
    assert hole.begin_ns < SECOND <= hole.end_ns < 2 * SECOND


def test_a_part_that_has_just_begun_hides_nothing_of_the_part_before(tmp_path):
    world, cloud = files(tmp_path, [], cloud_records(50, SECOND), ("a", "a"))
    write(part_before(world), world_records(50, SECOND), "world", "a")
    assert len(merge(world, cloud)["/odometry"]) == 50
    write(part_before(world), [], "world", "a")
    assert len(merge(world, cloud)["/odometry"]) == 0


def test_unrelated_clocks_begin_together_also_in_a_torn_file(tmp_path):
    cloud = [one for one in cloud_records(150, SECOND) if not isinstance(one, rec.Arrival)]
    ends = files(tmp_path, world_records(150, 7 * SECOND), cloud, ("a", "b"))
    noted = {"clock_offset_ns": str(6 * SECOND), "clock_offset_method": "first records"}
    assert noted.items() <= merge(*ends).metadata.items()
    ends[1].write_bytes(ends[1].read_bytes()[: ends[1].stat().st_size // 2])
    mission, recording = merged(tmp_path)
    assert recording.note == mission.note
    assert mission.note.startswith("cloud: cut short: ")
    assert len(recording["/odometry"]) == 150
    assert 50 <= len(recording["/pid"]) == len(recording["/cmd_vel"]) < 150


@pytest.mark.parametrize(("lost", "rows"), [("world", (0, 9)), ("cloud", (9, 0))])
def test_one_end_alone_is_better_than_nothing(tmp_path, lost, rows):
    files(tmp_path, world_records(9), cloud_records(9), ("x", "y"))
    (tmp_path / f"{lost}.mcap").write_bytes(b"")
    _, recording = merged(tmp_path)
    assert f"{lost}.mcap: is empty" in recording.note
    assert recording.metadata["clock"] != lost
    assert (len(recording["/odometry"]), len(recording["/pid"])) == rows
    with pytest.raises(BadInputError, match=r"no\.mcap: cannot be read"):
        merge(tmp_path / "no.mcap", tmp_path / "none.mcap")


def slipping(records, slips_ns):
    """Yield world's records; the n-th telemetry has the n-th slip, later ones the last slip."""
    slips, slip = iter(slips_ns), 0
    for record in records:
        if isinstance(record, rec.TelemetrySent):
            slip = next(slips, slip)
            record = record._replace(telemetry=record.telemetry._replace(slip_ns=slip))
        yield record


def test_a_slip_of_world_is_taken_out_of_clouds_stamps(tmp_path):
    world = slipping(world_records(60, 4 * SECOND), [5 * SECOND])
    cloud = cloud_records(60, 4 * SECOND + 5 * SECOND)
    mission = merge(*files(tmp_path, world, cloud, ("same", "same")))
    without = Recording.from_records([], cloud_records(60, 4 * SECOND))
    found, asked = (each["/delay_estimate"]["stamp_ns"].tolist() for each in (mission, without))
    assert found == asked


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, SECOND), min_size=2, max_size=20), st.data())
def test_time_never_runs_backwards(steps, data):
    world = slipping(world_records(60, SECOND), np.cumsum(steps).tolist())
    telemetry = Recording.from_records(world)["/telemetry"]
    instants = st.lists(st.integers(0, 60 * SECOND), min_size=2, max_size=30)
    machine_ns = np.array(sorted(data.draw(instants)), dtype=np.int64)
    converted = world_time_ns(telemetry, machine_ns)
    assert (np.diff(converted) >= 0).all()
    assert (converted <= machine_ns).all()
    # A slip grows by up to 1 s in 10 ms, so 1 ns of world's clock is up to 101 ns of the machine's
    # clock. Each conversion rounds by half a nanosecond.
    assert (np.abs(machine_time_ns(telemetry, converted) - machine_ns) <= 51).all()
    if not any(steps):
        assert converted.tolist() == machine_ns.tolist()


def test_the_wall_time_of_the_start_is_kept(tmp_path):
    day_ns = 1_785_000_000 * SECOND  # wall time at world's stamp 0
    for end, records, offset_ns in (
        ("world", world_records(60, 9 * SECOND), day_ns),
        ("cloud", cloud_records(60, 4 * SECOND), day_ns + 5 * SECOND),
    ):
        with McapWriter(tmp_path / f"{end}.mcap", clock=end, wall_offset_ns=offset_ns) as writer:
            writer.write(records)
    metadata = merged(tmp_path)[1].metadata
    assert metadata["started"] == "2026-07-25T17:20:08.995+00:00", "by the packets"
    assert metadata["wall_clock_offset_ns"] == str(day_ns)


FIRST = {1: "started", 2: "reached", 3: "done"}


@pytest.mark.parametrize("late_ns", [0, 5 * MS])
@pytest.mark.parametrize(
    ("events", "kept"),
    [
        (FIRST | {10: "started", 20: "reached", 30: "done"}, [10, 20, 30]),
        (FIRST | {20: "reached", 30: "done"}, [20, 30]),  # not the earlier mission
        (FIRST | {10: "started", 20: "reached"}, [10, 20]),
        (FIRST | {30: "done"}, [1, 2, 3]),  # the later mission was cancelled before its start
        ({1: "started", 9.5: "done", 10: "started", 12: "done"}, [10, 12]),
    ],
)
def test_the_last_mission_is_kept_even_if_its_start_is_lost(tmp_path, events, kept, late_ns):
    """World and cloud write a record up to `late_ns` after its stamp."""
    records = [rec.MissionEvent(round(at * SECOND), word, 0, "") for at, word in events.items()]
    records.append(rec.Counted(40 * SECOND, "cloud", "", 0))
    mission = Recording.read(write(tmp_path / "m.mcap", records))
    mission.messages = [(topic, to_ns + late_ns, data) for topic, to_ns, data in mission.messages]
    assert cut_to_last_mission(mission) is ("done" in list(events.values())[-1:])
    assert (mission["/mission"]["stamp_ns"] / SECOND).tolist() == kept
