# SPDX-License-Identifier: Apache-2.0

"""How an episode begins and what the policy remembers, in `eval` as in `Networked`."""

import json

import gymnasium
import numpy as np
import pytest

from cloudrc.gym import Networked
from cloudrc.studies.eval.episode import play
from cloudrc.studies.eval.setup import Episode, EvalSetup

LINK = {"uplink": {"delay_ms": 50}, "downlink": {"delay_ms": 50}}
MEMORY = {"observe_age": True, "observe_actions": 6, "observe_step": True}
LINEAR = """
import numpy as np

WEIGHTS = np.array({weights})

def decide(seen):
    steps, late = seen["step"][0] / 1e6, 10 * seen["age"][0]
    return int(WEIGHTS @ [*seen["observation"], *(seen["actions"] - 0.5), late + steps] > 0)

def infer(observation):
    return {{"actions": [[decide(observation)]]}}
"""


def decider(weights):
    """Return the function that decides in a file of a policy with these weights, and the file."""
    source, names = LINEAR.format(weights=np.asarray(weights).tolist()), {}
    exec(source, names)  # noqa: S102
    return names["decide"], source


def flown(decide, seed, **given):
    """Return how long a policy holds the pole in `Networked` behind 100 ms [steps]."""
    env = Networked(gymnasium.make("CartPole-v1"), LINK, seed, **MEMORY, **given)
    seen, _ = env.reset(seed=seed)
    steps, ended = 0, False
    while not ended:
        seen, _, terminated, truncated, _ = env.step(decide(seen))
        steps, ended = steps + 1, terminated or truncated
    return steps


LAW = [-0.06, 0.5, 2.9, 1.6, 0.2, -0.3, -0.9, -0.7, 0.1, -0.1, 0.0]


@pytest.mark.parametrize("start", [None, "answer", 1])
@pytest.mark.parametrize("hold", ["repeat", "start"])
def test_an_episode_is_that_of_the_same_arguments_in_training(law, start, hold):
    decide, source = decider(LAW)
    setup = EvalSetup("CartPole-v1", law(source), start=start, hold=hold, **MEMORY)
    row = play(Episode(100.0, "newest", 3), setup)
    assert row["numbers"]["steps"] == flown(decide, 3, start=start, hold=hold)


def test_memory_adds_nothing_to_the_bytes_of_an_observation(law):
    _, source = decider(LAW)
    file = law(source)
    rows = [
        play(
            Episode(0.0, "newest", 1),
            EvalSetup("CartPole-v1", file, link="lte", observation_bytes=size, **MEMORY),
        )
        for size in (None, 4 * 4)
    ]
    assert rows[0] == rows[1]


def test_the_page_counts_episodes_that_tell_of_their_beginning(law, tmp_path, evaluate):
    limit = "--max-steps", 60, "--success-at", 60
    words = "--policy", law(), "--rtt", "0,200", "--seeds", 2, *limit
    out = "--out", tmp_path / "e", "-o", "json"
    document = json.loads(evaluate(*words, *out).out)
    assert [each["unanswered"] for each in document["outcomes"]] == [0, 0, 2]
    note = "before a second answer could act tell of their beginning (--start), not of the policy"
    page = (tmp_path / "e" / "report.html").read_text()
    assert f"{note}: newest at 200 ms 2 of 2" in page
    told = json.loads(evaluate(*words, *out, "--start", "none", "--hold", "start").out)["identity"]
    assert (told["start"], told["hold"]) == (None, "start")


def test_what_cannot_run_is_refused_before_anything_is_written(law, tmp_path, evaluate):
    words = "--policy", law(), "--seeds", 1, "--out", tmp_path / "e"
    for more in (["--executor", "async"], ["--executor", "ensemble"]):
        assert "floating-point numbers" in evaluate(*words, *more, code=2).err
    for start in ("2", "[0, 0]", "soon"):
        assert "error: --start" in evaluate(*words, "--start", start, code=2).err
    assert not (tmp_path / "e").exists()


def test_episodes_without_an_answer_are_told_at_the_beginning_and_on_the_page(
    law, tmp_path, evaluate
):
    words = "--policy", law(), "--seeds", 1, "--max-steps", 100, "--out", tmp_path / "e"
    said = evaluate(*words, "--compute", 20, "--rtt", "0,50,100")
    assert said.err.count("an answer takes 20 s, an episode 2 s; times are in s") == 1
    assert "newest at 100 ms: no step gets an answer" in said.out
    said = evaluate(*words, "--executor", "time-indexed,prefix", "--rtt", "0,100,200")
    line = "time-indexed at 100 ms, time-indexed at 200 ms, prefix at 100 ms, prefix at 200 ms: an"
    assert line in said.out


def train(rng, rounds=40, size=24):
    """Return the weights that the cross-entropy method finds in `Networked(start=None)`."""
    mean, deviation = np.array([0.02, 0.06, 2.0, 0.4, *[0.0] * 7]), np.ones(11)
    for _ in range(rounds):
        tried = mean + deviation * rng.standard_normal((size, 11))
        seeds = rng.integers(1000, 100_000, 2)
        lengths = [min(flown(decider(each)[0], int(n)) for n in seeds) for each in tried]
        best = np.argsort(lengths)[-6:]
        mean, deviation = tried[best].mean(0), tried[best].std(0) + 0.02
        if lengths[best[0]] == 500 and all(
            flown(decider(mean)[0], n) == 500 for n in range(100, 112)
        ):
            return mean
    raise AssertionError(f"nothing learned: {lengths}")


@pytest.mark.full
def test_a_policy_trained_behind_100_ms_is_judged_as_it_was_trained(law, tmp_path, evaluate):
    """`start="answer"` lets the first action act alone for the whole loop: the pole falls."""
    decide, source = decider(train(np.random.default_rng(1)))
    assert [flown(decide, seed) for seed in range(1, 7)] == [500] * 6
    words = ["--policy", law(source), "--rtt", 100, "--seeds", 6, "--success-at", 500]
    words += ["--observe-age", "--observe-actions", 6, "--observe-step", "-o", "json"]
    kept = {}
    for start in ("none", "answer"):
        said = evaluate(*words, "--out", tmp_path / start, "--start", start)
        *_, outcome = json.loads(said.out)["outcomes"]
        kept[start] = outcome["successes"], outcome["steps"] < 20
    assert kept == {"none": (6, False), "answer": (0, True)}
