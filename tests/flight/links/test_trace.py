# SPDX-License-Identifier: Apache-2.0

"""A trace of a run, and its report, have the losses of the link, also near the end."""

import numpy as np
import pytest

from cloudrc.flight.links.trace import one_way
from cloudrc.wire.records import Arrival
from tests.results.metrics.conftest import DONE, END, PERIOD, SECOND, START, UPLINK, flown, measured

TRANSIT = round(UPLINK * SECOND)
ALL = (END - START + SECOND) // PERIOD + 1


def losing(lost):
    """Log a flight whose uplink loses the datagrams of which `lost` tells by number and time [s].

    The times are those of sending, since the start of the mission.
    """
    log = flown()

    def keep(_, arrival):
        sent = (arrival.stamp_ns - TRANSIT - START) / SECOND
        return None if arrival.uplink and lost(arrival.counter, sent) else arrival

    log.change(Arrival, keep)
    return log


def ended(log, at_ns):
    """End the recording of a log at a stamp [ns]."""
    for records in (log.world, log.cloud):
        records[:] = [each for each in records if each.stamp_ns <= at_ns]
    return log


def trace(log):
    return one_way(log.flight().recording, "uplink")


def loss(log, way="uplink"):
    return measured(log.flight(), f"loss_{way}")


@pytest.mark.parametrize("first", [0, 10])
def test_a_trace_has_all_datagrams_of_a_time_from_the_one_that_opened_the_session(first):
    """Half of them arrive, in every part of the flight."""
    found = trace(losing(lambda counter, sent: counter < first or counter % 2))
    assert np.mean(np.isnan(found.delays)) == pytest.approx(0.5, abs=2e-3)
    assert found.sent[0] == pytest.approx(first * PERIOD / SECOND)
    assert len(found.delays) >= ALL - first - 3, "only those of the last 50 ms are left out"
    assert " ".join(found.notes).startswith(f"{first + 2} left out")


@pytest.mark.parametrize("span", [(9.0, 9.5), (9.5, 10.0), (8.2, 8.6)])
def test_the_loss_counts_a_blackout_shortly_before_the_end(span):
    first, last = span
    log = losing(lambda counter, sent: first <= sent < last)
    whole = (DONE - START) // PERIOD
    expected = (last - first) * SECOND / PERIOD / whole
    assert loss(log) == pytest.approx(expected, rel=0.05)
    assert loss(ended(log, DONE + TRANSIT)) == pytest.approx(expected, rel=0.05)
    assert loss(log, "downlink") == 0


def test_datagrams_under_way_at_the_end_do_not_count():
    log = ended(flown(), DONE)
    assert loss(log) == loss(log, "downlink") == 0
    assert not np.isnan(trace(log).delays).any()
