"""A comparison uses the metrics that both flights of a pair have."""

import pytest

from cloudrc.errors import BadInputError
from cloudrc.runs.compare import Pair, compare
from tests.runs.conftest import flown

UNITS = {"iae_mean": "m", "rtt_mean": "s"}


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


def test_incomplete_pairs_are_left_out_and_counted():
    whole, torn = flown(iae_mean=1.0, rtt_mean=1.0), flown(rtt_mean=2.0)
    found = compare(pairs((whole, whole), (whole, torn), (whole, flown("error"))), UNITS)
    assert (found["pairs"], found["left_out"]) == (2, 1)
    assert (found["numbers"]["iae_mean"]["count"], found["numbers"]["iae_mean"]["left_out"]) == (
        1,
        1,
    )
    assert [one["seed"] for one in found["flights"]] == [1, 2, 3]


def test_no_pairs_and_unknown_numbers_are_refused():
    with pytest.raises(BadInputError, match=r"no pair of flights to compare: each .* a reason"):
        compare(pairs((flown("error"), flown())), UNITS)
    with pytest.raises(BadInputError, match=r"no number named 'iea_mean'.*did you mean iae_mean"):
        compare(pairs((flown(iae_mean=1.0), flown(iae_mean=1.0))), UNITS, ["iea_mean"])


@pytest.mark.parametrize("code", ["plugin_failed", "onboard_failed"])
def test_numbers_of_a_plugin_that_failed_do_not_count(code):
    """Another plug-in took over, so B would look equal to A."""
    ok, failed = flown(iae_mean=1.0), flown("failure", code, iae_mean=1.0)
    found = compare(pairs((ok, ok), (ok, failed)), UNITS)
    assert (found["pairs"], found["left_out"]) == (1, 1)
    with pytest.raises(BadInputError, match="plug-in failed: a reason"):
        compare(pairs((ok, failed)), UNITS)


def test_numbers_that_differ_by_rounding_are_equal():
    both = [(flown(iae_mean=0.3), flown(iae_mean=0.1 + 0.2)) for _ in range(8)]
    found = compare(pairs(*both), UNITS)["numbers"]["iae_mean"]
    assert (found["difference"], found["interval"]) == (0.0, (0.0, 0.0))
    assert (found["lower"], found["higher"], found["decided"]) == (0, 0, False)
    assert (found["p_wilcoxon"], found["p_sign"]) == (1.0, 1.0)
