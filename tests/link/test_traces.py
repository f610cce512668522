"""Traces are read and written; an invalid trace is refused with file, line and remedy."""

import pytest

from cloudrc.errors import BadInputError
from cloudrc.link.profile import Trace
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
        (b"time_s,delay_ms\n0,0\n1,0\n", (0, 1), (0, 0), 0),
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
        (f"{HEAD}\n0,1,234.5", "line 2: more values than columns; give 2"),
        (f"{HEAD}\n0,0.045\n1,0.07", "delay_ms is at most 0.07, which looks like sec"),
        (f"{HEAD},loss\n0,45,1.2", "line 2: loss is '1.2'; give a number from 0 to 1"),
        (f"{HEAD}\n1705744800500,45", "time_s begins at 1705744800500, which is not in seconds"),
        (f"{HEAD}\n" + "".join(f"{n},{n % 3 * 50}\n" for n in range(12)), "is 0 in 4 of 12 rows"),
        ("45.1\n46.2\n44", "numbers without a header; a rate trace of mahimahi .* a trace: awk"),
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
