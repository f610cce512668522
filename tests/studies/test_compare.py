# SPDX-License-Identifier: Apache-2.0

"""A comparison uses the metrics that both flights of a pair have."""

import pytest

from cloudrc.studies.compare import Pair, compare
from cloudrc.studies.compare_text import as_text
from tests.support.sweeps import flown

UNITS = {"iae_mean": "m", "rtt_mean": "s"}
BYTES = {"J/J0": "1", "bytes_sent_uplink": "B"}


def pairs(*both):
    return [Pair({"seed": seed}, a, b) for seed, (a, b) in enumerate(both, start=1)]


def test_ten_equal_gains_are_decided():
    both = [(flown(iae_mean=5.0 + n), flown(iae_mean=4.0 + 0.9 * n)) for n in range(10)]
    found = compare(pairs(*both), UNITS)["numbers"]["iae_mean"]
    assert (found["a_median"], found["b_median"], found["unit"]) == (9.5, 8.05, "m")
    assert found["difference"] == pytest.approx(-1.45)
    assert (found["lower"], found["decided"]) == (10, True)
    assert found["p_wilcoxon"] == found["p_sign"] == pytest.approx(2 / 1024)


def test_success_is_compared_by_pairs():
    ok, bad = flown(), flown("failure")
    found = compare(pairs(*[(bad, ok)] * 7, (ok, ok), (ok, bad)), UNITS)["success"]
    assert (found["a"], found["b"], found["count"]) == (2, 8, 9)
    assert (found["only_a"], found["only_b"]) == (1, 7)
    assert found["p_mcnemar"] == pytest.approx(2 * (1 + 8) / 2**8)


def test_holms_p_is_over_the_success_and_all_numbers():
    """The p of ten equal gains is 2 / 2^10: three times this, then 2 and 1 times larger ones."""
    equal = flown(iae_mean=4.0, rtt_mean=1)
    both = [(flown(iae_mean=5.0 + n, rtt_mean=n % 3), equal) for n in range(10)]
    document = compare(pairs(*both), UNITS, ["iae_mean", "rtt_mean"])
    found = document["numbers"]
    assert found["iae_mean"]["p_holm"] == pytest.approx(3 * found["iae_mean"]["p_wilcoxon"])
    assert document["success"]["p_holm"] == found["rtt_mean"]["p_holm"] == 1.0
    text = as_text({"a": "x=1", "b": "x=2", "of": "steps", **document})
    assert "3 tests and intervals at 95 %: about 0.15 of them" in text


def test_incomplete_pairs_are_left_out_and_counted():
    whole, torn = flown(iae_mean=1.0, rtt_mean=1.0), flown(rtt_mean=2.0)
    found = compare(pairs((whole, whole), (whole, torn), (whole, flown("error"))), UNITS)
    assert (found["pairs"], found["left_out"]) == (2, 1)
    iae = found["numbers"]["iae_mean"]
    assert (iae["count"], iae["left_out"]) == (1, 1)
    assert [one["seed"] for one in found["flights"]] == [1, 2, 3]


def test_the_relative_cost_and_the_bytes_come_first_where_they_are_known():
    a = flown(iae_mean=1.0, bytes_sent_uplink=2.0)
    assert list(compare(pairs((a, a)), {**UNITS, **BYTES})["numbers"]) == ["iae_mean"]
    a["numbers"]["J/J0"] = 1.5
    found = compare(pairs((a, a)), {**UNITS, **BYTES})["numbers"]
    assert list(found) == ["J/J0", "bytes_sent_uplink", "iae_mean"]


def test_where_the_setpoint_waits_a_failure_is_worse_than_every_success():
    """It has the number of what it flew, which is small if it stopped at once."""
    ok, late, bad = (
        flown(verdict, **{"off_ideal_path": size, "T/T0": 1.0})
        for verdict, size in (("success", 0.005), ("success", 0.012), ("failure", 0.001))
    )
    both = [(ok, bad)] * 5 + [(late, bad), (bad, bad)]
    units = {"off_ideal_path": "m", "T/T0": "1"}
    found = compare(pairs(*both), units)
    off = found["numbers"]["off_ideal_path"]
    assert (off["lower"], off["higher"], off["count"]) == (0, 6, 7)
    assert (off["b_median"], off["b_failed"]) == (0.001, 7)
    assert off["difference"] == pytest.approx(0.007, rel=1e-3)
    text = as_text({"a": "x=1", "b": "x=2", "of": "paper", **found})
    assert "1*" in text
    assert "in place of J/J0" in text


@pytest.mark.parametrize("code", ["plugin_failed", "onboard_failed"])
def test_numbers_of_a_plugin_that_failed_do_not_count(code):
    """Another plug-in took over, so B would look equal to A."""
    ok, failed = flown(iae_mean=1.0), flown("failure", code, iae_mean=1.0)
    found = compare(pairs((ok, ok), (ok, failed)), UNITS)
    assert (found["pairs"], found["left_out"]) == (1, 1)
