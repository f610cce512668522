"""The band of the delay figure shows the configured link profile."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cloudrc.config.schema import Change, Direction
from cloudrc.report.figures.marks import band, bounds_at


def bounds(direction: Direction, time: float) -> tuple[float, float]:
    steps = band(direction)
    assert steps is not None
    low, high = bounds_at(steps, np.array([time]))
    return low[0], high[0]


def test_delay_and_jitter() -> None:
    direction = Direction(delay_ms=45.0, jitter_ms=25.0)
    assert bounds(direction, 3.0) == pytest.approx((0.020, 0.070))


def test_a_delay_is_never_negative() -> None:
    assert bounds(Direction(delay_ms=5.0, jitter_ms=20.0), 0.0) == pytest.approx((0.0, 0.025))


def test_changes_hold_from_their_instant_on() -> None:
    changes = (Change(at_s=10.0, delay_ms=70.0), Change(at_s=20.0, jitter_ms=5.0))
    direction = Direction(delay_ms=20.0, jitter_ms=10.0, changes=changes)
    assert bounds(direction, 9.99) == pytest.approx((0.010, 0.030))
    assert bounds(direction, 10.0) == pytest.approx((0.060, 0.080))
    assert bounds(direction, 25.0) == pytest.approx((0.065, 0.075))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])  # the second as Excel writes it
def test_a_trace_replaces_the_delay(tmp_path: Path, encoding: str) -> None:
    trace = tmp_path / "trace.csv"
    trace.write_text("time_s,delay_ms,loss\n1,30,0\n5,90,0\n", encoding=encoding)
    direction = Direction(delay_ms=5.0, jitter_ms=10.0, trace=str(trace))
    assert bounds(direction, 0.0) == pytest.approx((0.020, 0.040))  # the first row holds before it
    assert bounds(direction, 6.0) == pytest.approx((0.080, 0.100))


def test_a_missing_trace_has_no_band(tmp_path: Path) -> None:
    assert band(Direction(trace=str(tmp_path / "gone.csv"))) is None


def test_a_trace_that_loops_has_a_band_after_hours(tmp_path: Path) -> None:
    """Its last row lasts as long as a mean row, so one pass takes 2 s."""
    trace = tmp_path / "trace.csv"
    trace.write_text("time_s,delay_ms\n0,30\n1,90\n")
    direction = Direction(jitter_ms=10.0, trace=str(trace), loop=True)
    for time, low in ((0.5, 0.020), (1.5, 0.080), (7200.5, 0.020), (7201.5, 0.080)):
        assert bounds(direction, time) == pytest.approx((low, low + 0.020))
