# SPDX-License-Identifier: Apache-2.0

"""Tables: heads with units, separators, and what is refused with its file and line."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.base.outside.tables import SECONDS, SHARE, CsvTable
from cloudrc.base.outside.values import Quantity

HEAD = "time_s,loss"


def read(data, folder):
    """Return times [s] and shares of a file."""
    path = folder / "t.csv"
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    table = CsvTable.read(path, "table t.csv", HEAD)
    time = table.column(("time", "at"), SECONDS)
    share = table.find(("loss",), SHARE, Quantity(ge=0, le=1))
    table.refuse_others(time, share)
    return [
        (row.number(time) * time.scale, share and row.number(share) * share.scale)
        for row in table.rows
    ]


@pytest.mark.parametrize(
    "data",
    [
        "time_s,loss\n1.5,0.01\n",
        "# made by hand\n\nat_ms;loss_pct\n1500;1\n\n# the end",
        "TIME_NS\tLoss (%)\n1.5e9\t1\n",
        "time milliseconds;loss\n1500;0.01\n",
        '\ufeff"Time [s]", loss%\r\n"1.5", 1\r\n',
        "loss_percent,at_us\n1,1500000".encode("utf-16"),
    ],
)
def test_a_table_is_read_in_the_units_of_its_head(data, tmp_path):
    assert read(data, tmp_path) == [pytest.approx((1.5, 0.01))]


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ("", "line 1: no header; the first line must name the columns, such as time_s,loss"),
        ("# time_s loss\n1.5e3 0 nan\n", "line 2: numbers without a header"),
        (f"{HEAD}\n1,0\n2,0,5\n", "line 3: 3 values for 2 columns; write numbers without commas"),
        (f"{HEAD}\n\n1\n", "line 3: 1 values for 2 columns$"),
        ("time_s;loss\n1;0,5\n", "line 2: loss: '0,5' has a decimal comma; write a point"),
        (f"{HEAD}_pct\n1,120\n", "line 2: loss_pct: '120' is not a number >= 0 and <= 100"),
        ("time_s,loss,Loss\n", "line 1: column Loss is there twice"),
        ("time_s,at_ms\n", "several columns of one kind: time_s, at_ms"),
        ("time,loss\n", "column time has no unit; name it time_s or time_ms or time_us or time_ns"),
        ("tme_s,loss\n", "no column time_s or .*; it has tme_s, loss; .*; did you mean time_s?"),
        ("time_s,los\n", "column los means nothing here; .*; did you mean loss?"),
        (f"{HEAD}\n1,{'0' * 200_000}\n", "line 2: field larger than"),
    ],
)
def test_a_table_that_could_be_misread_is_refused_with_its_place(data, says, tmp_path):
    with pytest.raises(BadInputError, match=rf"^table t\.csv[^\n]*{says}"):
        read(data, tmp_path)
