"""The feed turns records into lines and back, and never blocks."""

import os

import pytest

from cloudrc.drivers.feed import PERIOD_NS, Feed, from_line, to_line
from cloudrc.drivers.machine import clock_id
from cloudrc.messages import UPRIGHT, ZERO, GuardState, Odometry, Telemetry
from cloudrc.records import GuardChange, MissionEvent, TelemetrySent


def sent(stamp_ns):
    odometry = Odometry(stamp_ns, (1.0, 2.0, 3.0), UPRIGHT, ZERO, ZERO)
    telemetry = Telemetry(stamp_ns, odometry, 0.5, 1, 2, 3, 4, GuardState.TRACK, 2, 0.1)
    return TelemetrySent(stamp_ns, 1, 2, telemetry)


EVENT = MissionEvent(5, "reached", 1, 'waypoint "2" of 7 \u2013 reached')


@pytest.mark.parametrize("record", [sent(7), EVENT, GuardChange(1, GuardState.HOLD, "why")])
def test_a_record_comes_back_as_it_was(record):
    back = from_line(to_line(record))
    assert back == record
    assert type(back) is type(record)
    assert "\n" not in to_line(record)


@pytest.mark.parametrize("line", ["", "ready", "{}", '["Nobody", []]', '["MissionEvent", [1]]'])
def test_what_is_no_record_is_refused(line):
    with pytest.raises(ValueError, match="not a record"):
        from_line(line)


def test_events_are_all_told_and_samples_ten_times_a_second():
    reader, writer = os.pipe()
    feed = Feed(writer)
    feed.ready()
    for k in range(20):
        feed.tell([sent(k * PERIOD_NS // 4), EVENT])
    lines = os.read(reader, 1 << 20).decode().splitlines()
    assert lines[0] == "ready"
    told = [type(from_line(line)) for line in lines[1:]]
    assert (told.count(MissionEvent), told.count(TelemetrySent)) == (20, 5)
    os.close(reader)
    feed.tell([EVENT])  # nobody reads any more: no error
    os.close(writer)


def test_where_nobody_watches_events_are_said_in_words():
    reader, writer = os.pipe()
    feed = Feed(writer, watched=False)
    feed.tell([sent(0), EVENT])
    assert os.read(reader, 1 << 20).decode().splitlines() == [EVENT.text]
    os.close(reader)
    os.close(writer)


def test_a_full_pipe_does_not_block():
    reader, writer = os.pipe()
    feed = Feed(writer)
    for _ in range(5000):
        feed.tell([EVENT])
    os.close(reader)
    os.close(writer)


def test_a_line_is_told_whole_however_long_and_in_any_characters():
    """A pipe holds 64 KiB; the rest of a longer line is written before the next line."""
    reader, writer = os.pipe()
    os.set_blocking(reader, False)
    feed, data = Feed(writer), b""
    long = EVENT._replace(text="x" * 150_000)
    for event in (long, EVENT, EVENT, EVENT):
        feed.tell([event])
        data += os.read(reader, 1 << 20)
    *lines, rest = data.decode().split("\n")
    assert ([from_line(line) for line in lines], rest) == ([long, EVENT, EVENT], "")
    Feed(writer, watched=False).tell([EVENT._replace(text="caf\udce9")])
    assert os.read(reader, 100) == b"caf\\udce9\n"
    os.close(reader)
    os.close(writer)


def test_processes_of_one_machine_share_their_clock():
    assert clock_id() == clock_id()
    assert len(clock_id()) == 16
