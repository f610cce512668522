# SPDX-License-Identifier: Apache-2.0

"""Measure a flight with the metric beside this file; pytest runs it."""

from pathlib import Path

import cloudrc

METRIC = Path(__file__).with_name("metric.py")


def test_the_metric_measures_a_flight() -> None:
    """The robot climbs to its place, and stays there."""
    flight = cloudrc.fly("hover", {"report.metrics": [str(METRIC)]})
    assert flight.units[METRIC.stem] == "m"
    assert 0.5 < flight.numbers[METRIC.stem] < 5.0
