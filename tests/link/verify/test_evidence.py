# SPDX-License-Identifier: Apache-2.0

"""Evidence is read from the state, metrics and qdiscs of a link container."""

from cloudrc.base.outside.prometheus import read_metrics
from cloudrc.link.verify.causes import ShaperFacts, read_evidence

NETEM = {"kind": "netem", "handle": "7401:", "packets": 85, "drops": 15}
METRICS = """
cloudrc_link_release_error_seconds{percentile="99"} 0.0021
cloudrc_link_datagrams_total{outcome="received"} 500
cloudrc_link_datagrams_total{outcome="unread"} 3
cloudrc_cpu_periods_total 100
cloudrc_cpu_throttled_periods_total 40
cloudrc_link_restored_total 2
"""


def test_metrics_report_lateness_counts_and_stops():
    page, found = {"shaper": "relay", "reason": "link.mode=relay"}, read_metrics(METRICS)
    known = read_evidence(page, found, 600)
    assert (known.passed, known.sent, known.restored) == (503, 600, 2)
    assert known.starved == (
        "3 datagrams not read in time, 1 % released later than 2.10 ms, stopped in 40 of 100 CPU"
        " periods"
    )
    assert read_evidence(page, found).passed is None, "since its start"
    nothing = ShaperFacts("relay", "link.mode=relay", sent=5)
    assert read_evidence(page, {}, 5) == nothing, "without tools nothing is claimed"
    netem = {"shaper": "netem", "interface": "eth0", "netems": {"eth0": [NETEM]}}
    assert read_evidence(netem, {}, 100).passed == 100, "counted by the kernel"
