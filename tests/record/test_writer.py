"""The file is a valid MCAP and at most half a second behind."""

from __future__ import annotations

import io
import tracemalloc
from collections import defaultdict
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap_ros2.decoder import DecoderFactory

from cloudrc.messages import GuardState
from cloudrc.record.columns import Recording
from cloudrc.record.topics import TOPICS, rows
from cloudrc.record.writer import CHUNK_NS, McapWriter
from cloudrc.records import GuardChange
from tests.record.conftest import MS, SECOND, cloud_records, world_records, write

RECORDS = [*world_records(150), *cloud_records(150, 1500 * MS)]


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("flight") / "both.mcap", RECORDS)


def test_the_file_is_what_ros_tools_expect(flight: Path) -> None:
    with flight.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == sum(len(rows(record)) for record in RECORDS)
        assert {schema.encoding for schema in summary.schemas.values()} == {"ros2msg"}
        assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
        for channel in summary.channels.values():
            ros_type = summary.schemas[channel.schema_id].name
            assert ros_type == TOPICS[channel.topic].ros_type
            assert channel.metadata["topic_type_hash"].startswith("RIHS01_")
        assert len(summary.chunk_indexes) >= 6
        for chunk in summary.chunk_indexes:
            assert chunk.compression == "zstd"
            assert chunk.message_end_time - chunk.message_start_time < CHUNK_NS


def test_log_times_never_fall_on_a_topic(tmp_path: Path) -> None:
    states = [GuardChange(stamp, GuardState.HOLD, "") for stamp in (5, 9, 7, 8, 12)]
    path = write(tmp_path / "back.mcap", states)
    times = defaultdict(list)
    with path.open("rb") as stream:
        for _, channel, message in make_reader(stream).iter_messages():
            times[channel.topic].append(message.log_time)
    assert times == {"/guard": [5, 9, 9, 9, 12]}
    assert Recording.read(path)["/guard"]["stamp_ns"].tolist() == [5, 9, 7, 8, 12]


def test_data_older_than_half_a_second_is_flushed() -> None:
    stream = io.BytesIO()
    writer = McapWriter(stream, clock="world")
    states = [GuardChange(n * 10 * MS, GuardState.HOLD, str(n)) for n in range(200)]
    for state in states:
        writer.write([state])
        seen = stream.getvalue()
        assert state.stamp_ns < CHUNK_NS or state.stamp_ns - newest(seen) <= CHUNK_NS
    writer.close()


def newest(data: bytes) -> int:
    """Return the log time of the last message in a complete chunk [ns]."""
    end = 0
    try:
        for record in StreamReader(io.BytesIO(data), emit_chunks=True).records:
            end = record.message_end_time if isinstance(record, Chunk) else end
    except Exception:  # the file has no end yet
        return end
    raise AssertionError("the file is not yet ended")


def test_attachments_and_metadata_come_back(tmp_path: Path) -> None:
    path, report = tmp_path / "a.mcap", b'{"verdict": "success"}'
    with McapWriter(path, clock="cloud", clock_id="boot-1") as writer:
        writer.write(cloud_records(3))
        writer.note({"epoch": "1"})
        writer.note({"epoch": "2"})
        writer.attach("report.json", report, "application/json")
        writer.attach("empty", b"")
    recording = Recording.read(path)
    assert recording.complete
    assert recording.attachments == {"report.json": report, "empty": b""}
    expected = {"clock": "cloud", "clock_id": "boot-1", "epoch": "2"}
    assert expected.items() <= recording.metadata.items()
    assert recording.metadata["version"]


def test_another_decoder_reads_every_topic(flight: Path) -> None:
    with flight.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        stamps = defaultdict(list)
        for _, channel, _, message in reader.iter_decoded_messages():
            stamp = message.header.stamp
            stamps[channel.topic].append(stamp.sec * SECOND + stamp.nanosec)
    recording = Recording.read(flight)
    assert stamps.keys() == set(TOPICS) - {"/lateness", "/link", "/link_check"}
    for topic, found in stamps.items():
        assert found == recording[topic]["stamp_ns"].tolist()


def test_an_hour_of_recording_takes_no_memory(tmp_path: Path) -> None:
    """A chunk every quarter of a second: mcap's own list of them takes 20 MB in an hour."""
    path, records = tmp_path / "long.mcap", world_records(1)
    grown, count = list[int](), 200
    tracemalloc.start()
    try:
        with McapWriter(path, clock="world") as writer:
            for n in range(2 * count + 1):
                stamp_ns = n * SECOND // 4
                writer.write([record._replace(stamp_ns=stamp_ns) for record in records])
                writer.flush()
                if n % count == 0:
                    grown.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    per_hour = (grown[2] - grown[1]) / count * 4 * 3600
    assert per_hour < 3e6, "bytes; ours grows in steps"
    with path.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert summary is not None
        assert len(summary.chunk_indexes) == 2 * count + 1
        assert sum(1 for _ in reader.iter_messages(["/odometry"])) == 2 * count + 1
