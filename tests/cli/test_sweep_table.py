"""Tables of a sweep: the interval of the median, missing numbers, the CSV file."""

from __future__ import annotations

import csv
import io
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.cli.sweep import as_csv, as_table, interval, summarise


def report(seed: int, verdict: str = "success", **numbers: float) -> dict[str, Any]:
    return {
        "seed": seed,
        "verdict": verdict,
        "numbers": {name: {"value": value, "unit": "m"} for name, value in numbers.items()},
    }


@pytest.mark.parametrize(
    ("n", "bounds"),
    [
        (5, None),  # minimum and maximum enclose the median with 1 - 2/32 = 0.9375 only
        (6, (1, 6)),  # 1 - 2/64 = 0.969
        (9, (2, 8)),  # 1 - 2 * 10/512 = 0.961
        (10, (2, 9)),  # 1 - 2 * 11/1024 = 0.979; (3, 8) has 0.891
        (20, (6, 15)),  # 0.9586 in textbooks
    ],
)
def test_the_interval_has_the_bounds_computed_by_hand(
    n: int, bounds: tuple[float, float] | None
) -> None:
    assert interval([float(i) for i in range(n, 0, -1)]) == bounds


@given(st.lists(st.floats(-1e6, 1e6), min_size=6, max_size=40))
@settings(max_examples=50, deadline=None)
def test_the_interval_encloses_the_median(values: list[float]) -> None:
    bounds = interval(values)
    median = summarise([report(i, x=v) for i, v in enumerate(values)])["numbers"]["x"]["median"]
    assert bounds is not None
    assert bounds[0] <= median <= bounds[1]


def test_statistics_skip_runs_that_lack_a_number() -> None:
    summary = summarise([report(1, x=1.0), report(2, "failure"), report(3, x=3.0)])
    assert (summary["done"], summary["count"]) == (2, 3)
    assert summary["numbers"]["x"]["median"] == 2.0
    assert summary["numbers"]["x"]["count"] == 2
    assert "(2 runs)" in as_table(summary)
    assert as_table(summary).endswith("done 2/3")


def test_the_csv_has_one_line_per_seed_and_leaves_gaps_empty() -> None:
    rows = list(csv.reader(io.StringIO(as_csv([report(1, x=1.0), report(2, "failure", y=2.0)]))))
    assert rows == [
        ["seed", "verdict", "x [m]", "y [m]"],
        ["1", "success", "1.0", ""],
        ["2", "failure", "", "2.0"],
    ]
