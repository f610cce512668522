"""Valid traces are read; bad ones are rejected with file, line, value and remedy."""

from __future__ import annotations

from pathlib import Path

import pytest

from cloudrc.errors import BadInputError
from cloudrc.link.traces import parse_trace, read_table, read_trace


def test_a_trace_is_read_into_si(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_text("time_s, delay_ms, loss\n0, 45, 0\n0.5, 60.5, 0.25\n\n2,0,1\n")
    trace = read_trace(path)
    assert trace.times == (0.0, 0.5, 2.0)
    assert trace.delays == pytest.approx((0.045, 0.0605, 0.0))
    assert trace.losses == (0.0, 0.25, 1.0)


def test_the_columns_may_stand_in_any_order_and_loss_be_absent() -> None:
    trace = parse_trace(["delay_ms,time_s", "45,0"], "x")
    assert (trace.times, trace.delays, trace.losses) == ((0.0,), (0.045,), None)


def test_a_file_from_a_spreadsheet_is_read(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_bytes(b"\xef\xbb\xbftime_s,delay_ms\r\n0,45\r\n")
    assert read_trace(path).delays == (0.045,)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1: no column time_s, found nothing"),
        ("time_s\n0\n", "line 1: no column delay_ms, found time_s"),
        ("time_s,delay\n0,1\n", "line 1: no column delay_ms"),
        ("time_s,delay_ms,lost\n0,1,0\n", "line 1: column 'lost' is unknown"),
        ("time_s,delay_ms,delay_ms\n0,1,1\n", "column 'delay_ms' is unknown or repeated"),
        ("time_s,delay_ms\n", "no rows"),
        ("time_s,delay_ms\n1,45\n0.5,45\n", "line 3: time_s 0.5 does not come after 1; sort"),
        ("time_s,delay_ms\n1,45\n1,45\n", "line 3: time_s 1 does not come after 1"),
        ("time_s,delay_ms\n-1,45\n", "line 2: time_s is -1; give a number that is finite"),
        ("time_s,delay_ms\n0,-5\n", "line 2: delay_ms is -5; give a number that is finite"),
        ("time_s,delay_ms\n0,nan\n", "line 2: delay_ms is nan"),
        ("time_s,delay_ms\n0,inf\n", "line 2: delay_ms is inf"),
        ("time_s,delay_ms\n0,fast\n", "line 2: delay_ms is 'fast'; give a number"),
        ("time_s,delay_ms\n0\n", "line 2: delay_ms is nothing; give a number"),
        ("time_s,delay_ms\n0,0.045\n1,0.07\n", "delay_ms is at most 0.07, which looks like sec"),
        ("time_s,delay_ms,delay_us\n0,1,1\n", "line 1: delay_ms and delay_us; give one"),
        ("time_s,delay_ms\n0,1,2\n", "line 2: more values than columns; give 2"),
        ("time_s,delay_ms,loss\n0,45,1.2\n", "line 2: loss is 1.2; give a number from 0 to 1"),
        ("time_s,delay_ms,loss\n0,45,nan\n", "line 2: loss is nan"),
        ("time_s,delay_ms\n0," + "9" * 200_000, "field larger than field limit"),
        ("\0\1\2", "no column time_s"),
    ],
)
def test_what_is_not_a_trace_is_refused(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "trace.csv"
    path.write_text(text)
    with pytest.raises(BadInputError) as caught:
        read_trace(path)
    message = str(caught.value)
    assert message.startswith(f"trace {path}")
    assert says in message
    assert "\n" not in message


def test_a_file_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="No such file"):
        read_trace(tmp_path / "none.csv")
    with pytest.raises(BadInputError, match="Is a directory"):
        read_trace(tmp_path)
    (tmp_path / "binary.csv").write_bytes(b"\xff\xfe\xff")
    with pytest.raises(BadInputError, match="not a text file"):
        read_trace(tmp_path / "binary.csv")


def test_short_delays_need_microseconds_and_zero_any_unit() -> None:
    assert parse_trace(["time_s,delay_us", "0,45"], "x").delays == pytest.approx((45e-6,))
    assert parse_trace(["time_s,delay_ms", "0,0", "1,0"], "x").delays == (0.0, 0.0)


def test_a_table_is_the_arrived_delays_with_mean_0_deviation_1(tmp_path: Path) -> None:
    path = tmp_path / "trace.csv"
    path.write_text("time_s,delay_ms,loss\n0,60,0\n1,40,0.5\n2,900,1\n3,40,0\n4,60,0\n")
    assert read_table(path) == pytest.approx((-1.0, -1.0, 1.0, 1.0))


@pytest.mark.parametrize("rows", ["0,45,0", "0,45,0\n1,45,0", "0,45,1\n1,50,1"])
def test_a_table_without_a_spread_is_refused(tmp_path: Path, rows: str) -> None:
    path = tmp_path / "trace.csv"
    path.write_text(f"time_s,delay_ms,loss\n{rows}\n")
    with pytest.raises(BadInputError, match="at least two different delays"):
        read_table(path)
