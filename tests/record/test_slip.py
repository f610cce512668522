"""Cloud's records are converted correctly to world's clock after its lags."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.record.columns import Recording
from cloudrc.record.merge import WorldTime, merge
from cloudrc.records import Record, TelemetrySent
from tests.record.conftest import MS, SECOND, cloud_records, world_records, write


def slipping(records: list[Record], slips_ns: list[int]) -> list[Record]:
    """Make world's records; the n-th telemetry has the n-th slip, later ones the last slip."""
    slips, found = iter(slips_ns), []
    slip = 0
    for record in records:
        if isinstance(record, TelemetrySent):
            slip = next(slips, slip)
            telemetry = record.telemetry._replace(slip_ns=slip)
            record = record._replace(telemetry=telemetry)
        found.append(record)
    return found


def test_a_slip_of_five_seconds_is_taken_out_of_clouds_stamps(tmp_path: Path) -> None:
    world = slipping(world_records(60, 4 * SECOND), [5 * SECOND])
    cloud = cloud_records(60, 4 * SECOND + 5 * SECOND)
    paths = (
        write(tmp_path / "w.mcap", world, "world", "same"),
        write(tmp_path / "c.mcap", cloud, "cloud", "same"),
    )
    stamps = merge(*paths).recording()["/delay_estimate"]["stamp_ns"]
    without = Recording.from_records([], cloud_records(60, 4 * SECOND))
    assert stamps.tolist() == without["/delay_estimate"]["stamp_ns"].tolist()


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, SECOND), min_size=2, max_size=20), st.data())
def test_time_never_runs_backwards(steps: list[int], data: st.DataObject) -> None:
    world = slipping(world_records(60, SECOND), np.cumsum(steps).tolist())
    time = WorldTime(Recording.from_records(world)["/telemetry"])
    instants = st.lists(st.integers(0, 60 * SECOND), min_size=2, max_size=30)
    machine_ns = np.array(sorted(data.draw(instants)), dtype=np.int64)
    converted = time.at(machine_ns)
    assert (np.diff(converted) >= 0).all()
    assert (converted <= machine_ns).all()


def test_without_a_slip_nothing_moves() -> None:
    time = WorldTime(Recording.from_records(world_records(60, SECOND))["/telemetry"])
    machine_ns = np.array([0, 7, 3 * SECOND + MS])
    assert time.at(machine_ns).tolist() == machine_ns.tolist()
