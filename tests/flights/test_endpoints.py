# SPDX-License-Identifier: Apache-2.0

"""World without a link: when commands act, and what happens after a stall."""

from itertools import pairwise

import pytest

from cloudrc.wire.records import CommandApplied, Fault, GroundTruth
from tests.flights.conftest import MS, talking

talk = pytest.fixture(talking)


@pytest.mark.parametrize(
    "wakes", [(), (21_300_000,), (20_500_000, 21_300_000), (20 * MS, 20 * MS + 1)]
)
def test_a_command_is_applied_at_the_next_step_after_any_wake(talk, wakes):
    for wake in wakes:
        talk.world.handle_deadline(wake)
    talk.now_ns = 21_300_000
    talk.send(talk.command(basis_ns=20 * MS))
    talk.wait(8.7)
    (applied,) = talk.take(CommandApplied)
    assert (applied.stamp_ns, applied.counter) == (22 * MS, 0)
    told = talk.telemetry
    assert (told.stamp_ns, told.echo_stamp_ns, told.echo_hold_ns) == (30 * MS, 21_300_000, 8 * MS)


def test_a_command_at_a_sample_waits_for_the_next_step(talk):
    """The same result in real time, where its time is a little later."""
    talk.now_ns = 20 * MS
    talk.world.handle_deadline(talk.now_ns)
    talk.send(talk.command(basis_ns=20 * MS))
    talk.wait(10)
    assert [applied.stamp_ns for applied in talk.take(CommandApplied)] == [22 * MS]


def test_after_a_stall_waiting_commands_are_stale(talk):
    data = talk.command()
    talk.now_ns = 60 * MS  # a short delay is caught up
    talk.world.handle_deadline(talk.now_ns)
    assert talk.world.slip_ns == 0
    stamps = [truth.stamp_ns for truth in talk.take(GroundTruth)]
    assert {b - a for a, b in pairwise(stamps)} == {10 * MS}
    talk.now_ns = 5_000 * MS  # the process stalled while the datagram was in the socket
    talk.send(data)
    assert talk.world.slip_ns > 4_000 * MS
    assert talk.counts()["stale"] == 1
    talk.now_ns += 5_000 * MS
    talk.world.handle_deadline(talk.now_ns)
    talk.counts()
    talk.now_ns += 5_000 * MS
    talk.world.handle_deadline(talk.now_ns)
    talk.counts()
    assert [fault.code for fault in talk.take(Fault)] == ["late"], "reported once"
    assert talk.take(CommandApplied) == []
