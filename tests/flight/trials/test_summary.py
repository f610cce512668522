# SPDX-License-Identifier: Apache-2.0

"""Flights with several seeds are summarised in one table."""

from cloudrc.flight.trials.summary import as_table, summarise
from tests.support.sweeps import flown


def test_numbers_may_be_missing_and_failed_plugins_do_not_count():
    failed = flown("failure", "plugin_failed", x=9.0)
    rows = [flown(x=1.0), flown("failure", y=2.0), flown(x=3.0), failed]
    summary = summarise(rows, {"x": "m", "y": "1"})
    assert (summary["done"], summary["count"]) == (2, 4)
    assert (summary["numbers"]["x"]["median"], summary["numbers"]["x"]["count"]) == (2.0, 2)
    assert "(2 runs)" in as_table(summary)


def test_a_median_with_flights_that_failed_is_marked():
    rows = [flown(x=1.0), flown("failure", "not_settled", x=5e-7)]
    shown = as_table(summarise(rows, {"x": "m"}))
    assert "0.5000*" in shown
    assert "* contains flights that failed" in shown
    assert "*" not in as_table(summarise(rows[:1], {"x": "m"}))
