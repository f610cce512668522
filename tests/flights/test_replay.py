# SPDX-License-Identifier: Apache-2.0

"""A trace of a flight's delays gives the same delays and losses when it is replayed."""

import numpy as np

from cloudrc.flight.links.trace import one_way
from cloudrc.link.trace_logs import trace_of
from cloudrc.link.traces import write_trace
from tests.flights.conftest import fly


def uplink(*settings):
    settings = ("mission.steps.count=5", "guard.command_age_max_ms=1000", *settings)
    return one_way(fly("steps", *settings).flight.recording, "uplink")


def test_a_replayed_flight_gives_its_delays_and_losses_again(tmp_path):
    """The replaying link begins 4 packets before the first telemetry, its trace some later."""
    path, flown = tmp_path / "t.csv", uplink("link.profile=lossy")
    path.write_text(write_trace(trace_of(flown)))
    again = uplink("link.profile=ideal", f"link.uplink.trace={path}")
    asked, got = (np.nan_to_num(packets.delays, nan=-1.0) for packets in (flown, again))
    assert np.sum(asked < 0) > 20
    left_out = 4 + round(again.sent[0] * 100)
    assert np.abs(asked[left_out:][200:1800] - got[200:1800]).max() < 1e-6
