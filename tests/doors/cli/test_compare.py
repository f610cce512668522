# SPDX-License-Identifier: Apache-2.0

"""`cloudrc compare`: flights of A and B in pairs, a table and one sentence that answers."""

import json

import pytest

from tests.doors.cli.conftest import SHORT
from tests.support.sweeps import flown

A, B = "cloud.predictor=last_sample", "cloud.predictor=constant_velocity"
COMPARE = f"compare {A} {B} "


@pytest.fixture
def fly_with(replace_flights):
    """Replace flights: `measure(is_a, seed)` returns verdict and prediction error [m]."""

    def use(measure):
        def fly(experiment):
            verdict, error = measure(experiment.cloud.predictor.name in A, experiment.seed)
            failures = ["unstable"] * (verdict == "failure")
            return flown(verdict, *failures, prediction_error_rms=error)

        replace_flights(fly)

    return use


@pytest.mark.usefixtures("one_core")
def test_short_flights_are_compared_for_real(as_json):
    document = as_json(f"compare {A} {B},cloud.estimator=split --seeds 1", *SHORT)
    sides = A, f"{B},cloud.estimator=split"
    assert (document["a"], document["b"], document["pairs"]) == (*sides, 1)
    number = document["numbers"]["prediction_error_rms"]
    assert number["b_median"] < number["a_median"]
    assert (number["interval"], number["decided"]) == (None, False)


@pytest.mark.parametrize(
    ("seeds", "measure", "answer"),
    [
        (8, lambda is_a, n: ("success", 0.01 + 0.0013 * n * is_a),
         "B has a lower prediction_error_rms: by 5.850 mm (2.600 .. 9.100), p = 0.0078, in 8 "
         "of 8 pairs.\n"),
        (5, lambda is_a, n: ("success", 0.01 + 0.0013 * n * is_a),
         "Undecided: prediction_error_rms after 5 pairs, p = 0.062; about 11 pairs needed.\n"),
        (6, lambda is_a, n: ("failure" if is_a else "success", 0.01),
         "B succeeds more often: in 6 of 6 flights, A in 0, p = 0.031.\n"
         "Undecided: prediction_error_rms after 6 pairs, p = 1; no effect seen.\n"),
        # One large difference against seven: the ranks decide, the signs do not.
        (20, lambda is_a, n: ("success", 0.1 - is_a * (0.0001 * n if n > 6 else -0.00005 * n)),
         "This holds if the differences are symmetric; the sign test, which does not assume it, "
         "does not confirm it (p = 0.12).\n"),
    ],
)  # fmt: skip
def test_the_last_lines_are_the_answer(seeds, measure, answer, fly_with, call):
    fly_with(measure)
    assert call(f"{COMPARE} --seeds {seeds}").out.endswith(answer)


def test_numbers_of_flights_that_failed_are_marked(fly_with, call, as_json):
    """A robot that hardly moves has a small error: the table must not show it as a gain."""
    fly_with(lambda is_a, n: ("failure", 5e-7) if is_a and n < 3 else ("success", 0.01))
    out = call(f"{COMPARE} --seeds 3").out
    row = next(line for line in out.splitlines() if line.startswith("prediction_error_rms"))
    a_median, b_median = row.split()[1:3]
    assert (a_median[-1], b_median[-1] == "*") == ("*", False)
    assert "\n* contains flights that failed" in out
    number = as_json(f"{COMPARE} --seeds 3")["numbers"]["prediction_error_rms"]
    assert (number["a_failed"], number["b_failed"]) == (2, 0)


def test_ctrl_c_compares_the_finished_pairs(fly_with, call):
    def measure(is_a, seed):
        if seed > 2:
            raise KeyboardInterrupt
        return "success", 0.01

    fly_with(measure)
    out, error = call(f"{COMPARE} --seeds 9 -o json", code=130)
    assert "interrupted: 2 pairs are finished" in error
    assert json.loads(out)["pairs"] == 2


@pytest.mark.full
def test_ten_pairs_decide_between_two_predictors(as_json):
    sides = f"{B} cloud.predictor=constant_acceleration"
    document = as_json(f"compare {sides} --set=link.profile=paper-p3")
    found = document["numbers"]["prediction_error_rms"]
    assert found["p_wilcoxon"] <= 0.01
    assert found["lower"] == 10, "pairs in which eq. (3) predicts worse"
