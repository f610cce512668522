# SPDX-License-Identifier: Apache-2.0

"""Traces are read and written; an invalid trace is refused with file and line."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.link.profile import Trace
from cloudrc.link.traces import parse_trace, read_trace, write_trace

HEAD = "time_s,delay_ms"


@pytest.mark.parametrize(
    ("data", "times", "delays", "losses"),
    [
        (f"{HEAD}, loss\n0, 45, 0\n.5, 60, .2\n\n2,0,1\n", (0, 0.5, 2), (45, 60, 0), (0, 0.2, 1)),
        ("delay_us,time_s\n45000,0\n", (0,), (45,), None),
        ("time_ms;delay_s;loss_pct\n500;0.045;1\n", (0.5,), (45,), (0.01,)),
        ('\ufeff"time_s","delay_ms"\r\n0,45\r\n', (0,), (45,), None),
        (f"# measured\n{HEAD}\n1705744800.5,45\n1705744801.5,46\n", (0, 1), (45, 46), None),
    ],
)
def test_a_trace_is_read_into_si(tmp_path, data, times, delays, losses):
    path = tmp_path / "trace.csv"
    path.write_text(data)
    trace = read_trace(path)
    assert trace.times == pytest.approx(times)
    assert trace.delays == pytest.approx([delay * 1e-3 for delay in delays])
    assert trace.losses == losses


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("0,45\n1,46", "line 1: numbers without a header"),
        ("time_s,rtt_ms\n0,45", "no column delay_s or delay_ms"),
        (f"{HEAD}\n1,45\n1,45", "line 3: time 1 s does not come after 1 s; sort"),
        (f"{HEAD}\n0,-1", "line 2: delay_ms: '-1' is not a number >= 0"),
        (f"{HEAD},loss\n0,45,1.2", "line 2: loss: '1.2' is not a number >= 0 and <= 1"),
    ],
)
def test_an_invalid_trace_is_refused(text, says):
    with pytest.raises(BadInputError, match=f"^trace x\\.csv[^\\n]*{says}"):
        parse_trace(text.splitlines(), "x.csv")


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_a_written_trace_reads_back_the_same(scale):
    delays = tuple(delay * scale for delay in (0.040, 0.045, 0.060))
    trace = Trace((0.0, 0.005, 0.015), delays, (0.0, 1.0, 0.5))
    again = parse_trace(write_trace(trace).splitlines(), "x")
    assert again.times == pytest.approx(trace.times)
    assert again.delays == pytest.approx(trace.delays)
    assert again.losses == trace.losses
