"""Traces are read and written; an invalid trace is refused with file, line and remedy."""

import pytest

from cloudrc.errors import BadInputError
from cloudrc.link import traces
from cloudrc.link.profile import Conditions, DirectionProfile, Timeline, Trace
from cloudrc.link.traces import parse_trace, read_table, read_trace, write_trace

HEAD = "time_s,delay_ms"


@pytest.mark.parametrize(
    ("data", "times", "delays", "losses"),
    [
        (b"time_s, delay_ms, loss\n0, 45, 0\n.5, 60, .2\n\n2,0,1\n", (0, 0.5, 2), (45, 60, 0), 1),
        (b"delay_us,time_s\n45000,0\n", (0,), (45,), 0),
        (b'\xef\xbb\xbf"time_s","delay_ms"\r\n0,45\r\n', (0,), (45,), 0),
        ("time_s;delay_ms\n0;45,5\n".encode("utf-16"), (0,), (45.5,), 0),
        (b"# measured\ntime_s,delay_ms\n1705744800.5,45\n1705744801.5,46\n", (0, 1), (45, 46), 0),
        (b"time_s,delay_ms\n39504.8,45\n39505.8,46\n", (0, 1), (45, 46), 0),
        (b"time_s,delay_ms\n0,0\n1,0.07\n", (0, 1), (0, 0.07), 0),
    ],
)
def test_a_trace_is_read_into_si(tmp_path, data, times, delays, losses):
    path = tmp_path / "trace.csv"
    path.write_bytes(data)
    trace = read_trace(path)
    assert trace.times == pytest.approx(times)
    assert trace.delays == pytest.approx([delay * 1e-3 for delay in delays])
    assert (trace.losses is not None) == bool(losses)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1: the columns are missing; the header is time_s,delay_ms or"),
        (f"{HEAD},delay_us\n0,1,0", "the columns are"),
        (f"{HEAD},loss,loss\n0,1,0,0", "the columns are"),
        (HEAD, "no rows"),
        (f"{HEAD}\n1,45\n0.5,45", "line 3: time_s 0.5 does not come after 1; sort"),
        (f"{HEAD}\n1,45\n1,45", "line 3: time_s 1 does not come after 1"),
        (f"{HEAD}\n-1,45", "line 2: time_s is '-1'; give a number that is finite"),
        (f"{HEAD}\n0,-1", "line 2: delay_ms is '-1'; give a number that is finite and"),
        (f"{HEAD}\n0,fast", "line 2: delay_ms is 'fast'; give a number"),
        (f"{HEAD}\n0,", "line 2: delay_ms is nothing; give a number"),
        (f"{HEAD}\n0,4_5", "line 2: delay_ms is '4_5'; give a number"),
        (f"{HEAD}\n0,1,234.5", "line 2: more values than columns; give 2"),
        (f"{HEAD},loss\n0,45,1.2", "line 2: loss is '1.2'; give a number from 0 to 1"),
        (f"{HEAD}\n1705744800500,45", "time_s begins at 1705744800500, which is not in seconds"),
        ("0,45\n1,46", "numbers without a header; the first line must be time_s,delay_ms"),
        (f'{HEAD}\n0,"' + "9" * 200_000, "field larger than field limit"),
    ],
)
def test_an_invalid_trace_is_refused(text, says):
    with pytest.raises(BadInputError, match=f"^trace x\\.csv[^\\n]*{says}") as caught:
        parse_trace(text.splitlines(), "x.csv")
    assert len(str(caught.value)) < 300


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / "binary.csv").write_bytes(b"\0\1\2")
    for name, says in (("none", "No such file"), (".", "Is a dir"), ("binary.csv", "not a text")):
        with pytest.raises(BadInputError, match=says):
            read_trace(tmp_path / name)


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_a_written_trace_reads_back_the_same(scale):
    delays = tuple(delay * scale for delay in (0.040, 0.045, 0.060))
    trace = Trace((0.0, 0.005, 0.015), delays, (0.0, 1.0, 0.5))
    again = parse_trace(write_trace(trace).splitlines(), "x")
    assert again.times == pytest.approx(trace.times)
    assert again.delays == pytest.approx(trace.delays)
    assert again.losses == trace.losses


def test_a_table_is_the_arrived_delays_with_mean_0_deviation_1(tmp_path):
    path = tmp_path / "trace.csv"
    path.write_text(f"{HEAD},loss\n0,60,0\n1,40,0.5\n2,900,1\n3,40,0\n4,60,0\n")
    assert read_table(path) == pytest.approx((-1.0, -1.0, 1.0, 1.0))
    path.write_text(f"{HEAD},loss\n0,45,0\n1,45,0\n2,50,1\n")
    with pytest.raises(BadInputError, match="at least two different delays"):
        read_table(path)


def test_an_unchanged_file_is_read_once_and_a_changed_one_anew(tmp_path, monkeypatch):
    path, reads = tmp_path / "trace.csv", []
    path.write_text(f"{HEAD}\n0,45\n")
    real = traces.read
    monkeypatch.setattr(traces, "read", lambda *given: reads.append(given) or real(*given))
    assert read_trace(path) is read_trace(path)
    assert len(reads) == 1
    path.write_text(f"{HEAD}\n0,45\n1,50\n")
    assert read_trace(path).times == (0.0, 1.0)


def test_a_file_that_takes_long_is_named_with_its_rows(tmp_path, monkeypatch, caplog):
    path = tmp_path / "trace.csv"
    path.write_text(f"{HEAD}\n" + "".join(f"{n},45\n" for n in range(1200)))
    real = traces.parse_trace
    monkeypatch.setattr(traces, "SILENT", 0.0)

    def parse(lines, name):
        while not caplog.records:
            pass  # until the command has spoken
        return real(lines, name)

    monkeypatch.setattr(traces, "parse_trace", parse)
    read_trace(path)
    assert caplog.messages == [f"reads {path}: 1,200 rows"]


def test_each_row_of_a_trace_is_a_piece_of_the_time_line():
    trace = Trace((0.5, 1.0, 2.0), (0.01, 0.02, 0.03), (0.0, 0.5, 1.0))
    line = Timeline(DirectionProfile(rows=trace, jitter_ms=2.0, rate_kbit=8.0))
    assert line.pass_ns == [0, 500_000_000, 1_000_000_000, 2_000_000_000]
    delays, losses = (10_000_000, 10_000_000, 20_000_000, 30_000_000), (0.0, 0.0, 0.5, 1.0)
    rest = (8000.0, False)
    assert line.pieces == [
        Conditions(delay, 0.002, loss, *rest) for delay, loss in zip(delays, losses, strict=True)
    ]


def test_equal_profiles_share_their_time_line():
    def line(*delays, **keys):
        trace = Trace(tuple(map(float, range(len(delays)))), delays)
        return Timeline(DirectionProfile(rows=trace, **keys))

    assert line(0.1, 0.2).pieces is line(0.1, 0.2).pieces
    assert line(0.1, 0.2).pieces != line(0.1, 0.3).pieces
    assert line(0.1, 0.2, loop=True).period_ns != line(0.1, 0.2).period_ns
