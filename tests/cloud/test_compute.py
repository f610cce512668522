# SPDX-License-Identifier: Apache-2.0

"""Cloud's compute time: its statistics, the CPU limit, and when a command leaves."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cloudrc.cloud.compute_time import ComputeTime
from cloudrc.config.load import load_experiment
from cloudrc.flight.virtual.flight import assemble
from cloudrc.wire.records import Arrival, Control, Fault
from tests.flights.conftest import fly_on

MS = 1_000_000


def test_a_random_time_has_its_mean_and_deviation():
    compute = ComputeTime(4 * MS, 3 * MS, np.random.default_rng(1))
    times = [compute.end(0) for _ in range(20_000)]
    assert (np.mean(times), np.std(times)) == pytest.approx((4 * MS, 3 * MS), rel=0.03)
    assert min(times) >= 0
    assert ComputeTime(4 * MS, 0.0, np.random.default_rng(1)).end(0) == 4 * MS


def test_a_measured_time_is_that_of_the_clock():
    clock = iter([100, 250]).__next__
    compute = ComputeTime(0.0, 0.0, np.random.default_rng(1), clock)
    compute.begin()
    assert compute.end(0) == 150


@pytest.mark.parametrize("compute_ms", [4, 14])
def test_a_command_leaves_after_its_stamp_and_compute_time(compute_ms):
    """While cloud computes, it begins no other command, and so it misses periods."""
    settings = "link.profile=ideal", f"cloud.compute_ms={compute_ms}"
    _, cloud, _, run = assemble(load_experiment("hover", settings))
    of_world, of_cloud = fly_on(run, 3000 * MS)
    began, arrived = (
        {(r.epoch, r.counter): r.stamp_ns for r in records if isinstance(r, kind)}
        for records, kind in ((of_cloud, Control), (of_world, Arrival))
    )
    assert len(arrived) > 40
    assert {arrived[sent] - began[sent] for sent in arrived} == {compute_ms * MS}
    assert set(np.diff([*began.values()])) == {max(compute_ms, 10) * MS}
    assert (cloud.counts["missed_periods"] > 0) == (compute_ms > 10)
    late = [record.code for record in of_cloud if isinstance(record, Fault)]
    assert late == ["late"] * (compute_ms > 10), "it is reported once"


def begun_and_lasted(cost_ms, share):
    """For 20 s, compute a command per 10 ms or after the last one; return both times [ms]."""
    compute, now_ns, found = ComputeTime(cost_ms * MS, 0.0, None, None, share), 0, []
    while now_ns < 20_000 * MS:
        lasts_ns = compute.end(now_ns)
        found.append((now_ns / MS, lasts_ns / MS))
        now_ns = max(now_ns + lasts_ns, (now_ns // (10 * MS) + 1) * 10 * MS)
    return np.array(found).T


def test_a_cpu_limit_stops_what_exceeds_its_share_of_100_ms_until_the_next_100_ms():
    begun, lasted = begun_and_lasted(7, 0.2)
    assert [*zip(begun[:4], lasted[:4], strict=True)] == [(0, 7), (10, 7), (20, 81), (101, 7)]
    assert len(lasted) * 7 == pytest.approx(0.2 * 20_000, rel=0.01), "it gets its share"
    assert set(begun_and_lasted(2, 0.2)[1]) == {2}, "it slows no command that fits"
    assert set(begun_and_lasted(7, 1.0)[1]) == {7}


LIMITS = {
    "/sys/fs/cgroup": {"cpu.max": "20000 100000", "cpu.weight": "10000"},
    "/sys/fs/cgroup/cpu": {
        "cpu.cfs_period_us": "100000", "cpu.cfs_quota_us": "20000", "cpu.shares": "100000",
    },
}  # fmt: skip
"""Place of control groups, version 2 and 1 -> a limit of 20 ms per 100 ms, and a high priority."""
BURNER = """
import json, sys, time
group, cost, found = sys.argv[1], int(sys.argv[2]), []
with open(group + "/cgroup.procs", "w") as file:
    file.write("0")
time.sleep(0.2)
begin = due = time.monotonic_ns()
while due < begin + 4_000_000_000:
    time.sleep(max(0, due - time.monotonic_ns()) * 1e-9)
    began, used = time.monotonic_ns(), time.thread_time_ns()
    while time.thread_time_ns() - used < cost:
        pass
    done = time.monotonic_ns()
    found.append((done - began) * 1e-6)
    due = max(done, begin + ((began - begin) // 10_000_000 + 1) * 10_000_000)
print(json.dumps(found))
"""


@pytest.fixture
def limited_group():
    """Make a control group with a CPU limit of 20 ms per 100 ms."""
    for place, limits in LIMITS.items():
        group = Path(place) / f"cloudrc-{os.getpid()}"
        if not (Path(place) / "cgroup.procs").exists():
            continue
        try:
            group.mkdir()
        except OSError as error:
            pytest.skip(f"control groups cannot be written: {error.strerror}")
        try:
            if not all((group / name).exists() for name in limits):
                pytest.skip("control groups here have no CPU limit")
            for name, value in limits.items():
                (group / name).write_text(value)
            yield group
        finally:
            group.rmdir()
        return
    pytest.skip("there are no control groups")


@pytest.mark.full
@pytest.mark.alone
@pytest.mark.process
@pytest.mark.parametrize("cost_ms", [3, 5, 10])
def test_a_container_with_a_cpu_limit_computes_as_long_as_the_model_says(cost_ms, limited_group):
    words = sys.executable, "-c", BURNER, limited_group, f"{cost_ms * MS}"
    real = np.array(json.loads(subprocess.run(words, capture_output=True, check=True).stdout))
    model = begun_and_lasted(cost_ms, 0.2)[1]
    print(f"{cost_ms} ms: real mean {real.mean():.1f}, p99 {np.percentile(real, 99):.1f} ms; "
          f"model {model.mean():.1f}, {np.percentile(model, 99):.1f} ms")  # fmt: skip
    assert np.mean(real) == pytest.approx(np.mean(model), rel=0.15)
    assert np.percentile(real, 99) == pytest.approx(np.percentile(model, 99), abs=10)
    stops = np.mean(real > cost_ms + 10), np.mean(model > cost_ms + 10)
    assert stops[0] == pytest.approx(stops[1], abs=0.1)


def test_of_given_times_each_computation_takes_a_random_one():
    given, draws = (1.0 * MS, 7.0 * MS), np.random.default_rng(1)
    compute = ComputeTime(0.0, 0.0, draws, times_ns=given)
    found = [compute.end(0) for _ in range(1000)]
    assert {*found} == {*given}
    assert np.mean(found) == pytest.approx(4 * MS, rel=0.1)
