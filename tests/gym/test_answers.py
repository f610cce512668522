# SPDX-License-Identifier: Apache-2.0

"""The stages of an answer add up to its age, in whole nanoseconds."""

import json

import gymnasium
import numpy as np
import pytest

from cloudrc.gym import Networked
from cloudrc.gym.ages import describe_ages
from cloudrc.gym.answers import CUTS, NEVER_NS, to_document
from cloudrc.results.timeline.loops import of_document
from cloudrc.results.timeline.text import as_text
from cloudrc.results.timeline.trace import write_trace
from tests.results.timeline.test_trace import check_rules

MS = 1_000_000
LINK = {"uplink": {"delay_ms": 130}, "downlink": {"delay_ms": 60}}
ROUGH = {
    "uplink": {"delay_ms": 130, "jitter_ms": 40, "loss": 0.2},
    "downlink": {"delay_ms": 60, "jitter_ms": 30, "loss": 0.1},
}


def play(link, steps=100, **options):
    """Play an episode of steps of 50 ms; return its environment and its last info."""
    env = Networked(gymnasium.make("Pendulum-v1"), link, dt=0.05, **options)
    env.reset(seed=1)
    answer = np.zeros(env.action_space.shape, np.float32)
    for _ in range(steps):
        *_, info = env.step(answer)
    return env, info["cloudrc"]


def cuts_of(env):
    table = env.timeline()
    return table["tick"], np.array([table[name] for name in CUTS])


@pytest.mark.parametrize(
    ("link", "options"),
    [
        (LINK, {"compute": 0.02}),
        (ROUGH, {"compute": (0.06, 0.03)}),
        (ROUGH, {"chunk": 8, "executor": "time_indexed"}),
        (ROUGH, {"chunk": 8, "executor": "ensemble"}),
        (ROUGH, {"delivery": "stream", "answer_within": 0.0}),
        ("ideal", {"start": "answer"}),
        (ROUGH, {"answers": "step"}),
    ],
)
def test_stages_add_up_to_the_age_of_each_executed_answer(link, options):
    env, _ = play(link, **options)
    ticks, cuts_ns = cuts_of(env)
    executed = cuts_ns[-1] != NEVER_NS
    stages_ns = np.diff(cuts_ns[:, executed], axis=0)
    assert executed.sum() > 10
    assert stages_ns.min() >= 0
    ages_ns = cuts_ns[-1, executed] - np.rint(ticks[executed] * 0.05e9).astype(int)
    assert (stages_ns.sum(axis=0) == ages_ns).all()
    summary = env.summary()
    means = [value for name, value in summary.items() if name.startswith("budget_")]
    assert sum(means) == pytest.approx(ages_ns.mean() * 1e-9, abs=1e-9)


def test_constant_delays_give_stages_by_hand():
    """130 ms up, 20 ms for the answer, 60 ms down: 210 ms, and 40 ms until the next step."""
    env, _ = play(LINK, compute=0.02)
    means = {name: value for name, value in env.summary().items() if name.startswith("budget_")}
    expected = {"observation": 0, "uplink": 0.13, "queue": 0, "compute": 0.02, "downlink": 0.06}
    expected = {f"budget_{name}": value for name, value in (expected | {"wait": 0.04}).items()}
    assert means == pytest.approx(expected, rel=0.03, abs=1e-6), "the first answer had no uplink"


def test_a_timeline_of_an_episode_tells_where_the_other_answers_ended():
    env, about = play(ROUGH, compute=0.12)
    document = to_document(env.timeline())
    loop = of_document(document)
    ended = loop.document["ended"]
    assert set(ended) == {"lost", "superseded"}
    assert 5 < ended["lost"] <= about["lost_uplink"] + about["lost_downlink"]
    assert "policy computes" in as_text(loop.document)
    assert len(document["ticks"]) <= 101
    _, flows = check_rules(json.loads(write_trace({"episode": loop}, 0.0, 60.0))["traceEvents"])
    assert len(flows) > 20


@pytest.mark.parametrize("count", [1, 2, 3, 50, 51, 100, 101, 977])
def test_the_percentile_of_ages_is_that_of_numpy_bit_by_bit(count):
    ages = np.random.default_rng(count).integers(0, 40, count) * 0.02
    assert describe_ages("age", ages, 0.02)["age_p99"] == np.percentile(ages, 99.0)
