"""`cloudrc compare`: flights of A and B in pairs, a table and one sentence that answers."""

import json

import pytest

from cloudrc.cli.main import main

SHORT = ["--set=mission.steps.count=1", "--set=mission.steps.period_s=1.0",
         "--set=criteria.settle_m=null"]  # fmt: skip


def fly_with(monkeypatch, measure):
    """Replace flights: `measure(predictor, seed)` returns verdict and prediction error [m]."""

    def fly(experiment):
        verdict, error = measure(experiment.cloud.predictor.name, experiment.seed)
        failures = ["unstable"] * (verdict == "failure")
        numbers = {"prediction_error_rms": error}
        return {"verdict": verdict, "failures": failures, "text": "it broke", "numbers": numbers}

    monkeypatch.setattr("cloudrc.sweep.flight.fly_point", fly)
    monkeypatch.setattr("cloudrc.cli.pool.usable_cores", lambda: 1)


def sentence(capsys, *arguments):
    """Return exit code and last line of `compare last_sample constant_velocity`."""
    sides = "cloud.predictor=last_sample", "cloud.predictor=constant_velocity"
    code = main(["compare", *sides, *arguments])
    return code, capsys.readouterr().out.splitlines()[-1]


def test_short_flights_are_compared_for_real(capsys):
    sides = "cloud.predictor=last_sample", "cloud.predictor=constant_velocity,cloud.estimator=split"
    assert main(["compare", *sides, "--seeds", "1", *SHORT, "-o", "json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["a"], document["b"], document["pairs"]) == (*sides, 1)
    number = document["numbers"]["prediction_error_rms"]
    assert number["b_median"] < number["a_median"]
    assert (number["interval"], number["decided"]) == (None, False)


@pytest.mark.parametrize(
    ("seeds", "answer"),
    [
        ("8", "B has a lower prediction_error_rms: by 5.850 mm (2.600 .. 9.100), p = 0.0078, in 8 "
              "of 8 pairs."),
        ("5", "Undecided: prediction_error_rms after 5 pairs, p = 0.062; about 11 pairs needed."),
    ],
)  # fmt: skip
def test_the_last_line_is_the_answer(seeds, answer, monkeypatch, capsys):
    fly_with(monkeypatch, lambda a, n: ("success", 0.01 + 0.0013 * n * ("last_sample" in a)))
    assert sentence(capsys, "--seeds", seeds) == (0, answer)


def test_success_comes_before_every_number(monkeypatch, capsys):
    fly_with(monkeypatch, lambda a, n: ("failure" if "last_sample" in a else "success", 0.01))
    sides = "cloud.predictor=last_sample", "cloud.predictor=constant_velocity"
    assert main(["compare", *sides, "--seeds", "6"]) == 0
    assert capsys.readouterr().out.splitlines()[-2:] == [
        "B succeeds more often: in 6 of 6 flights, A in 0, p = 0.031.",
        "Undecided: prediction_error_rms after 6 pairs, p = 1; no effect seen.",
    ]


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["seed=1", "seed=1"], "A and B are the same experiment"),
        (["cloud.predictor=last_sample", "cloud.predicter=kalman"], "cloud.predicter"),
        (["link.profile=paper-p1", "link.profile=wifi", "--set", "link.profile=x"], "set twice"),
        (
            ["last_sample", "nonsense"],
            "last_sample: is not KEY=VALUE; for a value of a sweep, add --in DIR",
        ),
        (["seed=1", "seed=2", "--number", "iae_men"], "--number: no number named 'iae_men'"),
        (["a", "b", "--in", "nowhere"], "nowhere"),
        (["a", "b", "--in", "nowhere", "--set", "seed=1"], "--set seed=1: these flights are"),
    ],
)
def test_what_cannot_be_compared_is_refused(arguments, text, capsys):
    assert main(["compare", *arguments]) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize("pairs", [2, 0])
def test_ctrl_c_compares_the_finished_pairs(pairs, monkeypatch, capsys):
    def measure(predictor, seed):
        if seed > pairs:
            raise KeyboardInterrupt
        return "success", 0.01

    fly_with(monkeypatch, measure)
    sides = "cloud.predictor=last_sample", "cloud.predictor=constant_velocity"
    assert main(["compare", *sides, "--seeds", "9", "-o", "json"]) == 130
    captured = capsys.readouterr()
    assert f"interrupted: {pairs} pairs are finished" in captured.err
    assert bool(captured.out) == bool(pairs)


@pytest.mark.full
def test_ten_pairs_decide_between_two_predictors(capsys, figure):
    sides = "cloud.predictor=constant_velocity", "cloud.predictor=constant_acceleration"
    assert main(["compare", *sides, "--set=link.profile=paper-p3", "-o", "json"]) == 0
    found = json.loads(capsys.readouterr().out)["numbers"]["prediction_error_rms"]
    figure("p of 10 pairs", found["p_wilcoxon"], "<=", 0.01)
    figure("pairs in which eq. (3) predicts worse", found["lower"], "==", 10)
