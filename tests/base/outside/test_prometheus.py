# SPDX-License-Identifier: Apache-2.0

"""Metrics are read as Prometheus reads them, and asked for by name and labels."""

import pytest

from cloudrc.base.outside.prometheus import read_metrics, total

SHOWN = r"""# HELP cloudrc_a_total Text with {braces="1"} 7
# TYPE cloudrc_a_total counter
cloudrc_a_total{direction="uplink",outcome="sent"} 3.0
cloudrc_a_total{outcome="used",direction="uplink"} 4.0
cloudrc_a_total{direction="x} 9,outcome=\"sent\""} 50.0
cloudrc_a_total_more 600.0
cloudrc_b_sum 0.25
"""


@pytest.mark.parametrize(
    ("name", "labels", "value"),
    [
        ("cloudrc_a_total", {}, 57.0),
        ("cloudrc_a_total", {"direction": "uplink"}, 7.0),
        ("cloudrc_a_total", {"direction": "uplink", "outcome": "used"}, 4.0),
        ("cloudrc_a_total", {"outcome": "lost"}, 0.0),
        ("cloudrc_b_sum", {}, 0.25),
        ("cloudrc_b", {}, 0.0),
    ],
)
def test_a_metric_is_the_sum_of_its_series_with_these_labels(name, labels, value):
    assert total(read_metrics(SHOWN), name, **labels) == value
