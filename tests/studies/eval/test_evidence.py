# SPDX-License-Identifier: Apache-2.0

"""What rows of an evaluation tell: survival, tests, pooled means, and doubts."""

from math import comb
from statistics import fmean

import pytest

from cloudrc.studies.eval.evidence import NOTHING, group, judge, least_kept, summarize, survivals
from cloudrc.studies.eval.setup import BASELINE


def rows(executor, rtt_ms, outcomes, **numbers):
    """Make a row per outcome: a truth value, or None if nobody knows the success."""
    verdicts = {True: "success", False: "failure", None: "done"}
    return [
        {
            "seed": seed,
            "point": {"rtt_ms": rtt_ms, "executor": executor},
            "verdict": verdicts[done],
            "ended": "truncated" if done else "terminated",
            "numbers": {
                **{"return": 500.0 if done else 20.0, "steps": 500 if done else 20},
                **({} if done is None else {"success": int(done)}),
                **{key: value[seed - 1] for key, value in numbers.items()},
            },
        }
        for seed, done in enumerate(outcomes, start=1)
    ]


def some(done):
    return [n < done for n in range(20)]


def flight(*kept, baseline=20):
    """Return rows without a network, and a condition per entry of `kept`: 0, 10, 20, ... ms."""
    return [
        *rows(BASELINE, None, some(baseline)),
        *(row for n, done in enumerate(kept) for row in rows("newest", 10.0 * n, some(done))),
    ]


@pytest.mark.parametrize(
    ("kept", "up_to", "text"),
    [
        ((20, 15, 14, 20), 10.0, "survives up to 10 ms; at 20 ms it keeps 14 of 20 successes"),
        ((20, 20), 10.0, "survives up to 10 ms"),
        ((3, 20), None, "is not shown to survive a round trip that was asked; at 0 ms it"),
    ],
)
def test_a_policy_survives_the_round_trips_before_the_first_that_is_not_shown(kept, up_to, text):
    """15 of 20 has a p of .0207, 14 of 20 one of .0577."""
    (found,) = survivals(group(flight(*kept)))
    assert found.get("up_to_ms") == up_to
    assert found["text"].startswith(f"newest {text}")
    few = 20 - found["kept"]
    assert found["p"] == pytest.approx(sum(comb(20, n) for n in range(few + 1)) / 2**20)


@pytest.mark.parametrize(
    ("executors", "least"),
    [
        (1, {5: 5, 6: 6, 8: 7, 10: 9, 15: 12, 20: 15, 50: 32, 100: 59}),
        (2, {5: None, 6: 6, 8: 8, 10: 9, 15: 12, 20: 15, 50: 33, 100: 61}),
        (3, {5: None, 6: 6, 8: 8, 10: 9, 15: 13, 20: 16, 50: 33, 100: 62}),
        (4, {5: None, 6: None, 8: 8, 10: 9, 15: 13, 20: 16, 50: 34, 100: 62}),
    ],
)
def test_more_executors_have_to_keep_more(executors, least):
    assert {count: least_kept(count, executors) for count in least} == least


def claims(count, kept, executors):
    """Return whether the first of so many executors is said to survive if it keeps `kept`."""
    world = rows(BASELINE, None, [True] * count)
    for n in range(executors):
        world += rows(f"executor {n}", 0.0, [each < (0 if n else kept) for each in range(count)])
    first, *_ = survivals(group(world))
    return "up_to_ms" in first


@pytest.mark.parametrize(
    ("count", "before"), [(5, 0.091), (8, 0.102), (10, 0.032), (13, 0.132), (18, 0.138)]
)
def test_a_false_claim_for_any_of_three_executors_has_at_most_5_percent(count, before):
    """Exact: each executor keeps half of the successes, the most for which a claim is false."""
    wrong = [
        sum(comb(count, n) for n in range(count + 1) if claims(count, n, executors)) / 2**count
        for executors in (1, 3)
    ]
    at_5_percent, adjusted = (1 - (1 - each) ** 3 for each in wrong)
    assert at_5_percent == pytest.approx(before, abs=0.0005)
    assert adjusted <= 0.05


def test_who_adds_seeds_until_it_shows_is_wrong_more_often_and_the_notes_say_so():
    """Exact: look after every 10 seeds, up to 100, at one executor that keeps half."""
    chances, wrong = {0: 1.0}, 0.0  # successes kept -> chance, of those who go on
    for count in range(1, 101):
        kept = range(count + 1)
        chances = {n: (chances.get(n, 0.0) + chances.get(n - 1, 0.0)) / 2 for n in kept}
        if count % 10 == 0:
            wrong += sum(chances.pop(n) for n in kept if n >= least_kept(count, 1))
    assert wrong == pytest.approx(0.125, abs=0.0005)
    notes = judge(flight(20), seeds=(10, 20))["notes"]
    assert any("10, then 20" in each for each in notes)
    assert not any("has changed" in each for each in judge(flight(20), seeds=(20,))["notes"])


def test_successes_that_the_network_gives_do_not_make_up_for_lost_ones():
    """Ten seeds succeed without a network; the network loses five of them and wins five others."""
    world = [
        *rows(BASELINE, None, some(10)),
        *rows("newest", 0.0, [5 <= n < 15 for n in range(20)]),
    ]
    (found,) = survivals(group(world))
    assert (found["of"], found["kept"], found.get("up_to_ms")) == (10, 5, None)


@pytest.mark.parametrize("outcomes", [[False] * 20, [None] * 20])
def test_without_a_success_without_a_network_nothing_is_said_to_survive(outcomes):
    found = judge([*rows(BASELINE, None, outcomes), *rows("newest", 0.0, outcomes)])
    assert (found["notes"][0], found["survival"]) == (NOTHING, [])


def test_means_of_steps_are_those_of_all_steps_and_say_of_how_many():
    """An episode of 400 steps counts a hundred times as much as one of 4."""
    ages = {"action_age": (0.1, 0.2), "action_age_of": (400, 4), "action_age_p99": (0.3, 0.5)}
    ages |= {"late_share": (0.0, 1.0), "loop_age": (0.1, 0.3), "observation_age_of": (0, 0)}
    found = summarize(50.0, "newest", rows("newest", 50.0, [True, False], **ages))
    assert found["action_age_ms"] == pytest.approx(1e3 * (400 * 0.1 + 4 * 0.2) / 404)
    assert (found["action_age_of"], found["late_share"]) == (404, pytest.approx(4 / 404))
    assert found["action_age_p99_ms"] == pytest.approx(1e3 * fmean((0.3, 0.5)))
    assert found["loop_age_ms"] == pytest.approx(200.0)
    assert "observation_age_ms" not in found
    assert [found[end] for end in ("terminated", "truncated", "limit")] == [1, 1, 0]
    assert (found["steps"], found["successes"], found["success"]) == (260, 1, 0.5)


def test_ages_are_counted_over_all_episodes_and_the_worst_window_is_that_of_any():
    largest = {"misses_in_10": (2.0, 3.0), "action_age_max": (0.4, 0.2)}
    some_rows = rows("newest", 50.0, [True, True], **largest)
    some_rows[0]["age_counts"], some_rows[1]["age_counts"] = [0, 5, 1], [0, 6]
    found = summarize(50.0, "newest", some_rows)
    assert (found["age_counts"], found["misses_in_10"]) == ([0, 11, 1], 3)
    assert found["action_age_max_ms"] == pytest.approx(400.0)


def test_executors_are_tested_in_pairs_of_equal_seeds():
    world = flight(20)
    world += rows("broker", 0.0, some(13))
    (found,) = judge(world)["tests"]
    success, change = found["success"], found["return"]
    assert (found["rtt_ms"], found["a"], found["b"]) == (0.0, "newest", "broker")
    assert (success["only_a"], success["only_b"]) == (7, 0)
    assert success["p_mcnemar"] == change["p_wilcoxon"] == pytest.approx(2 / 2**7)
    assert success["p_holm"] == change["p_holm"] == pytest.approx(4 / 2**7)
    assert change["count"] == 20


def test_another_policy_is_compared_in_each_condition_also_without_a_network():
    before, now = flight(20, 5), flight(20, 20)[:-5]
    found = judge(now, before, "runs/a")["tests"]
    assert [(each["rtt_ms"], each["a"], each["b"]) for each in found] == [
        (None, f"{BASELINE} of runs/a", BASELINE),
        (0.0, "newest of runs/a", "newest"),
        (10.0, "newest of runs/a", "newest"),
    ]
    last = found[-1]["success"]
    assert (last["count"], last["only_a"], last["only_b"]) == (15, 0, 10)
