"""Cloud's compute time: its statistics, and when a command leaves."""

import numpy as np
import pytest

from cloudrc import assembly
from cloudrc.cloud.compute import ComputeTime
from cloudrc.config.load import load_experiment
from cloudrc.records import Control, Fault
from cloudrc.tunnel.codec import Kind, peek
from cloudrc.tunnel.end import Identity
from tests.flights.conftest import VirtualRun, fly_on

MS = 1_000_000


def test_a_random_time_has_its_mean_and_deviation():
    compute = ComputeTime(4 * MS, 3 * MS, np.random.default_rng(1))
    times = [compute.end() for _ in range(20_000)]
    assert (np.mean(times), np.std(times)) == pytest.approx((4 * MS, 3 * MS), rel=0.03)
    assert min(times) >= 0
    assert ComputeTime(4 * MS, 0.0, np.random.default_rng(1)).end() == 4 * MS


def test_a_measured_time_is_that_of_the_clock():
    clock = iter([100, 250]).__next__
    compute = ComputeTime(0.0, 0.0, np.random.default_rng(1), clock)
    compute.begin()
    assert compute.end() == 150


class Spy:
    """Note when cloud makes a datagram available for sending."""

    def __init__(self, cloud):
        self.cloud, self.left = cloud, []

    def __getattr__(self, name):
        return getattr(self.cloud, name)

    def handle_deadline(self, now_ns):
        self.now_ns = now_ns
        self.cloud.handle_deadline(now_ns)

    def take_datagrams(self):
        found = self.cloud.take_datagrams()
        self.left += [self.now_ns for data in found if peek(data)[0] == Kind.COMMAND]
        return found


@pytest.mark.parametrize("compute_ms", [4, 14])
def test_a_command_leaves_after_its_stamp_and_compute_time(compute_ms):
    """While cloud computes, it begins no other command, and so it misses periods."""
    settings = "link.profile=ideal", f"cloud.compute_ms={compute_ms}"
    experiment = load_experiment("hover", settings)
    world = assembly.build_world(experiment, Identity(bytes(16), b"world".ljust(16)))
    spy = Spy(assembly.build_cloud(experiment, Identity(bytes(16), b"cloud".ljust(16))))
    _, records = fly_on(VirtualRun(world, spy, *assembly.build_links(experiment)), 3000 * MS)
    began = [record.stamp_ns for record in records if isinstance(record, Control)]
    assert len(began) > 40
    assert [left - compute_ms * MS for left in spy.left] == began[: len(spy.left)]
    assert set(np.diff(began)) == {max(compute_ms, 10) * MS}
    assert (spy.counts["missed_periods"] > 0) == (compute_ms > 10)
    late = [record.code for record in records if isinstance(record, Fault)]
    assert late == ["late"] * (compute_ms > 10), "it is reported once"
