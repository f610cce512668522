"""A comparison counts what both flights of a pair have; pairs come from finished flights."""

import json

import pytest

from cloudrc.errors import BadInputError
from cloudrc.sweep.compare import Pair, compare
from cloudrc.sweep.pairs import of_folders

UNITS = {"iae_mean": "m", "rtt_mean": "s"}


def flown(verdict="success", *failures, **numbers):
    text = "" if verdict == "success" else "a reason"
    return {"verdict": verdict, "failures": [*failures], "text": text, "numbers": numbers}


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


def test_pairs_without_a_number_or_an_end_are_left_out_and_counted():
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


def test_numbers_of_a_plugin_that_failed_do_not_count():
    """Another plug-in took over, so B would look equal to A."""
    ok, failed = flown(iae_mean=1.0), flown("failure", "plugin_failed", iae_mean=1.0)
    found = compare(pairs((ok, ok), (ok, failed)), UNITS)
    assert (found["pairs"], found["left_out"]) == (1, 1)
    with pytest.raises(BadInputError, match="plug-in failed: a reason"):
        compare(pairs((ok, failed)), UNITS)


def run_folder(path, seeds=(1, 2), mode="virtual", **changes):
    """Write what a comparison reads of `run --seeds`; `changes` are sections of the experiment."""
    for seed in seeds:
        (path / f"seed-{seed}").mkdir(parents=True)
        sections = {"cloud": {"predictor": {"name": "kalman"}}, "link": {"profile": "a"}}
        config = {"seed": seed, "name": path.name, **sections, **changes}
        number = {"value": float(seed), "unit": "s"}
        report = {"seed": seed, "mode": mode, "verdict": "success", "failures": []}
        report["numbers"] = {"settling_time_mean": number}
        (path / f"seed-{seed}/config.yaml").write_text(json.dumps(config))
        (path / f"seed-{seed}/report.json").write_text(json.dumps(report))
    return path


def test_two_folders_are_paired_by_seed(tmp_path):
    a = run_folder(tmp_path / "a", (1, 2, 3))
    b = run_folder(tmp_path / "b", (2, 3, 4), cloud={"predictor": {"name": "none", "gain": 1}})
    found, units, what = of_folders(a, b)
    assert units == {"settling_time_mean": "s"}
    assert [pair.label["seed"] for pair in found] == [2, 3]
    assert what == "folders that differ in cloud.predictor.gain, cloud.predictor.name"
    assert of_folders(a / "seed-2", b).pairs == found[:1]


def test_a_report_of_something_else_is_named(tmp_path):
    a, b = run_folder(tmp_path / "a"), run_folder(tmp_path / "b", cloud={})
    for text in ("{", "[]", "{}"):
        (b / "seed-2/report.json").write_text(text)
        with pytest.raises(BadInputError, match=r"seed-2/report.json: is not a report of cloudrc"):
            of_folders(a, b)


def test_limits_that_follow_the_link_profile_are_no_second_change(tmp_path):
    a = run_folder(tmp_path / "a", guard={"command_age_max_ms": 250})
    b = run_folder(tmp_path / "b", guard={"command_age_max_ms": 900}, link={"profile": "b"})
    assert of_folders(a, b).what == "folders that differ in link.profile"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({}, "are the same"),
        ({"link": {}, "cloud": {}}, "several sections: cloud.predictor.name, link.profile"),
        ({"mode": "local", "cloud": {}}, "several sections: cloud.predictor.name, mode"),
        ({"seeds": (8, 9)}, "no seed in common"),
    ],
)
def test_folders_that_nobody_could_compare_are_refused(changes, text, tmp_path):
    a, b = run_folder(tmp_path / "a"), run_folder(tmp_path / "b", **changes)
    with pytest.raises(BadInputError, match=text):
        of_folders(a, b)
