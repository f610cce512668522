# SPDX-License-Identifier: Apache-2.0

"""The file is a valid MCAP, and only recording needs the packages for it."""

import gc
import tracemalloc
from collections import defaultdict

from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from cloudrc.results.record.columns import Recording
from cloudrc.results.record.topics import TOPICS
from cloudrc.results.record.writer import CHUNK_NS, McapWriter
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import (
    FrameKept,
    FrameSent,
    FrameShown,
    GuardChange,
    Perceived,
    ScanTaken,
    TargetSeen,
)
from tests.results.record.conftest import MS, SECOND, cloud_records, world_records, write
from tests.support.programs import loaded

SEEN = (
    ScanTaken(3001 * MS, 1, 2, -0.5, 0.5, 0.125, 10.0, [1.0, 2.0, 0.5]),
    FrameSent(3001 * MS, 1, 2, 3000 * MS, 0, 7, 3, 2500, True, 40.5),
    FrameShown(3002 * MS, 1, 2, 3000 * MS, 0),
    FrameKept(3002 * MS, "jpeg", b"\xff\xd8"),
    TargetSeen(3002 * MS, (3.0, 0.0, 1.5), 0.1, 3.0, True),
    Perceived(3002 * MS, 3001 * MS, 0, 0, 0, 1, 2, (1.0, 2.0, 3.0)),
)
RECORDS = [*world_records(150), *cloud_records(150, 1500 * MS), *SEEN]


def test_other_programs_can_read_every_topic(tmp_path):
    path, stamps = write(tmp_path / "both.mcap", RECORDS), defaultdict(list)
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            stamp = message.header.stamp
            stamps[channel.topic].append(stamp.sec * SECOND + stamp.nanosec)
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    recording = Recording.read(path)
    assert stamps.keys() == set(TOPICS) - {"/lateness", "/link", "/link_check"}
    for topic, found in stamps.items():
        assert found == recording[topic]["stamp_ns"].tolist()
    assert summary.statistics.message_count == sum(map(len, stamps.values()))
    assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
    assert len(summary.chunk_indexes) >= 6
    for chunk in summary.chunk_indexes:
        assert chunk.compression == "zstd"
        assert chunk.message_end_time - chunk.message_start_time < CHUNK_NS


def test_log_times_never_fall_on_a_topic(tmp_path):
    states = [GuardChange(stamp, GuardState.HOLD, "") for stamp in (5, 9, 7, 8, 12)]
    path = write(tmp_path / "back.mcap", states)
    with path.open("rb") as stream:
        times = [message.log_time for _, _, message in make_reader(stream).iter_messages()]
    assert times == [5, 9, 9, 9, 12]
    assert Recording.read(path)["/guard"]["stamp_ns"].tolist() == [5, 9, 7, 8, 12]


def test_an_hour_of_recording_takes_no_memory(tmp_path):
    """With a chunk every half a second, an index of the chunks takes 12 MB for an hour."""
    path, records = tmp_path / "long.mcap", world_records(1)
    grown, count = list[int](), 60
    tracemalloc.start()
    try:
        with McapWriter(path, clock="world", index=False) as writer:
            for n in range(2 * count + 1):
                stamp_ns = n * SECOND // 2
                writer.write([record._replace(stamp_ns=stamp_ns) for record in records])
                writer.flush()
                if n % count == 0:
                    gc.collect()
                    grown.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert (grown[2] - grown[1]) / count * 2 * 3600 < 1e6, "bytes in an hour"
    with path.open("rb") as stream:
        assert sum(1 for _ in make_reader(stream).iter_messages(["/odometry"])) == 2 * count + 1
    assert Recording.read(path).note == ""


def test_a_flight_needs_no_package_for_recording():
    topics = "import cloudrc.results.record.topics"
    assert "numpy" not in loaded(topics)
    absent = "import sys; sys.modules |= dict.fromkeys(('mcap', 'rosbags'))"
    loaded(
        f"{absent}; {topics}; from cloudrc.results.record.columns import Recording;"
        "import cloudrc.flight.pod.recording; Recording.from_records([])['/pid']"
    )
