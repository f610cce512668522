# SPDX-License-Identifier: Apache-2.0

"""Evaluations: episodes over a link, their rows, tables and pages."""

import json
from hashlib import sha256
from itertools import count
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from cloudrc.base.errors import BadInputError, CloudrcError
from cloudrc.base.outside.values import InvalidValueError
from cloudrc.doors.cli.eval_values import (
    check_round_trips,
    read_compute,
    read_mapped,
)
from cloudrc.flight.pod.openpi.actions import PolicyAnswerError
from cloudrc.flight.pod.openpi.codec import pack
from cloudrc.studies.eval.episode import as_actions, play, width_of
from cloudrc.studies.eval.setup import Episode, EvalSetup, link_at
from cloudrc.studies.policy.observation import Mapped, observe
from tests.studies.eval.conftest import LAW
from tests.studies.policy.conftest import after, serving, stock_like
from tests.support.pages import blocks

SHAKY = """
import numpy as np
def infer(observation):
    x, y, speed = observation["observation/state"]
    return {"actions": np.full((3, 1), -2.0 * y - 0.5 * speed)}
"""


def bare(env_id, decide, **more):
    """Play the seed 3 without cloudrc; return the return and the hash of the world."""
    env, digest, total = gymnasium.make(env_id, **more), sha256(), 0.0
    observation, _ = env.reset(seed=3)
    digest.update(observation.tobytes())
    ended = False
    while not ended:
        action = decide(observation)
        observation, reward, terminated, truncated, _ = env.step(action)
        for value in (action, observation, float(reward)):
            digest.update(np.asarray(value).tobytes())
        total, ended = total + float(reward), terminated or truncated
    env.close()
    return total, digest.hexdigest()


def stand(observation):
    x, speed, angle, turn = observation
    return np.int64(10.0 * angle + 2.0 * turn + 0.1 * x + 0.3 * speed > 0.0)


def swing(observation):
    _, y, speed = observation
    return np.full((1,), -2.0 * y - 0.5 * speed).astype(np.float32)


@pytest.mark.parametrize(
    ("env_id", "source", "decide"),
    [("CartPole-v1", LAW, stand), ("Pendulum-v1", SHAKY, swing)],
    ids=["CartPole", "Pendulum"],
)
def test_an_ideal_link_without_compute_time_changes_no_bit_in_a_file_or_behind_a_socket(
    law, env_id, source, decide
):
    path, episode, given = law(source), Episode(None, "newest", 3), (("max_episode_steps", 100),)
    rows = [play(episode, EvalSetup(env_id, path, given))]
    with serving(path) as url:
        rows.append(play(episode, EvalSetup(env_id, url, given)))
    wanted = bare(env_id, decide, **dict(given))
    for row in rows:
        assert (row["numbers"]["return"], row["records_sha256"]) == wanted


@pytest.mark.parametrize("told", ["0.06", "times.csv"])
def test_the_time_for_an_answer_is_charged(law, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "times.csv").write_text("answer,seconds\n1,0.06\n2,0.06\n")
    compute, times = read_compute(told)
    setup = EvalSetup("CartPole-v1", law(), compute=compute, times=times)
    late = play(Episode(0.0, "newest", 1), setup)
    now = play(Episode(0.0, "newest", 1), EvalSetup("CartPole-v1", law()))
    assert now["numbers"]["action_age"] == 0.0
    assert late["numbers"]["action_age"] > 0.03


def test_a_measured_time_leaves_no_hash(law):
    setup = EvalSetup("CartPole-v1", law(), compute=("measured", ""))
    row = play(Episode(0.0, "newest", 1), setup)
    assert row["records_sha256"] == ""
    assert not setup.is_repeatable


class Task(gymnasium.Env):
    """Tells in one step that the task is done, under the key `key`."""

    dt = 0.1
    action_space = gymnasium.spaces.Box(-1, 1, (2,))
    observation_space = gymnasium.spaces.Dict({"eye": gymnasium.spaces.Box(0, 255, (2,), np.uint8)})

    eye = np.zeros(2, np.uint8)

    def __init__(self, key="success"):
        self.key = key

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return {"eye": self.eye}, {}

    def step(self, action):
        self.count += 1
        info = {self.key: np.float64(self.count == 3)}
        return {"eye": self.eye}, 1.0, self.count == 5, False, info


gymnasium.register("Task-v0", Task)
STILL = "def infer(observation):\n    return {'actions': [[0.0, 0.0]]}\n"


@pytest.mark.parametrize(
    ("key", "verdict"), [("success", "success"), ("is_success", "success"), ("other", "done")]
)
def test_a_success_is_what_the_info_says_in_any_step(law, key, verdict):
    setup = EvalSetup("Task-v0", law(STILL), (("key", key),))
    assert play(Episode(None, "newest", 1), setup)["verdict"] == verdict


def test_a_choice_that_the_environment_has_not_is_the_policys(law):
    policy = law("def infer(o): return {'actions': [[1], [2]]}")
    setup = EvalSetup("CartPole-v1", policy)
    with pytest.raises(CloudrcError, match=r"policy '.*': the action 2 is none of Discrete\(2\)"):
        play(Episode(None, "newest", 1), setup)


class Random(Task):
    """Begins differently each time, unless it gets a seed."""

    starts = count()

    def __init__(self, seed=None):
        super().__init__()
        self.eye = np.full(2, next(self.starts) if seed is None else seed, np.uint8)


gymnasium.register("Random-v0", Random)


@pytest.mark.parametrize(("more", "warned"), [([], True), (["--env-arg", "seed={seed}"], False)])
def test_an_environment_that_does_not_follow_its_seed_is_told_and_may_get_it(
    law, tmp_path, evaluate, more, warned
):
    words = "--env", "Random-v0", "--policy", law(STILL), "--seeds", 1, "--out", tmp_path / "e"
    assert ("not paired" in evaluate(*words, *more).err) is warned
    assert ("not paired" in (tmp_path / "e" / "report.html").read_text()) is warned
    document = json.loads((tmp_path / "e" / "eval.json").read_text())
    assert document["repeatable"] is not warned


def test_spaces_without_numbers_are_refused_and_whole_numbers_are_integers():
    with pytest.raises(InvalidValueError, match="Dict"):
        width_of(gymnasium.spaces.Dict({}))
    discrete = gymnasium.spaces.Discrete(3)
    assert as_actions(np.array([[1.0], [2.0]]), discrete).tolist() == [1, 2]
    integers = gymnasium.spaces.Box(0, 9, (1,), np.int8)
    assert as_actions(np.array([[1.0]]), integers).tolist() == [[1]]
    with pytest.raises(PolicyAnswerError, match=r"0\.5 does not fit"):
        as_actions(np.array([[0.5]]), integers)


def test_the_map_makes_the_policys_observation(tmp_path):
    path = tmp_path / "map.yaml"
    path.write_text("observation/state: robot.pose\nprompt: {value: go}\nall: .\n")
    mapped, seen = read_mapped(path), {"robot": {"pose": [1.0]}}
    assert observe(seen, mapped) == {"observation/state": [1.0], "prompt": "go", "all": seen}
    with pytest.raises(InvalidValueError, match=r"no 'eye\.left'; there are robot"):
        observe(seen, [Mapped("x", "eye.left")])
    for wrong in ("x: 3\n", "{}\n", "x: {path: y}\n"):
        path.write_text(wrong)
        with pytest.raises(BadInputError, match="for example"):
            read_mapped(path)


def test_a_round_trip_keeps_the_ratio_of_the_profile():
    asked = ("lte", 100.0), ("lte", 0.0), ("ideal", 80.0)
    links = [link_at(*each) for each in asked]
    delays = [(each.uplink.delay_ms, each.downlink.delay_ms) for each in links]
    assert delays == [(60.0, 40.0), (0.0, 0.0), (40.0, 40.0)]
    others = [(each.uplink.jitter_ms, each.uplink.loss) for each in links[:2]]
    assert others == [(8, 0.002), (0.0, 0.002)]
    with pytest.raises(BadInputError, match="change over time"):
        check_round_trips("handover", (80.0,))


SEES = """
import numpy as np
def infer(observation):
    prefix, delay = observation.get("prefix"), observation.get("delay")
    with open(__file__ + ".seen", "a") as file:
        if prefix is not None:
            print(*prefix.shape, delay, file=file)
    return {"actions": np.zeros((8, 1))}
"""


def test_executors_have_parameters_and_the_policy_sees_what_the_robot_has(law, tmp_path, evaluate):
    path, folder = law(SEES), tmp_path / "out"
    words = "--rtt 50 --seeds 1 --max-steps 20 --env Pendulum-v1 --policy".split()
    words += [path, "--out", folder, "--executor"]
    evaluate(*words, "rtc,async", "--set", "execute=2", "share=.25")
    evaluate(*words, "async", "--set", "share=.75", "-o", "json")
    rows = [json.loads(line) for line in (folder / "rows.jsonl").read_text().splitlines()]
    names = {row["point"]["executor"] for row in rows}
    assert names == {"no network", "rtc execute=2", "async share=0.25", "async share=0.75"}
    seen = Path(path + ".seen").read_text().splitlines()
    assert {*seen} == {"6 1 1"}  # after 2 of 8 actions; 50 ms are a step
    refused = evaluate(*words, "async", "--set", "shore=.5", code=2).err
    assert "--set: no parameter named 'shore'; " in refused


def test_an_evaluation_has_a_table_a_page_and_rows_and_continues(law, tmp_path, evaluate):
    words = ["--policy", law(), "--rtt", "0,200", "--max-steps", 60, "--success-at", 60]
    words += ["--out", tmp_path / "e"]
    evaluate(*words, "--seeds", 2)
    rows = (tmp_path / "e" / "rows.jsonl").read_text().splitlines()
    document = json.loads(evaluate(*words, "--seeds", 3, "-o", "json").out)
    more = (tmp_path / "e" / "rows.jsonl").read_text().splitlines()
    assert (len(rows), len(more), more[:6]) == (6, 9, rows)
    bare, near, far = document["outcomes"]
    assert (near["successes"], near["episodes"], far["successes"]) == (3, 3, 0)
    assert near["success_low"] == pytest.approx(0.292, abs=0.001)
    assert (bare["executor"], bare["rtt_ms"], bare["success"]) == ("no network", None, 1.0)
    assert document["versions"]["gymnasium"] == gymnasium.__version__
    assert document["command"].startswith("cloudrc eval --env CartPole-v1")


@pytest.mark.parametrize(
    ("last", "text"), [("ValueError: no", "ValueError: no"), (b"\x91\x01", "cannot be read")]
)
def test_a_server_that_fails_keeps_the_rows_and_is_one_line(tmp_path, evaluate, last, text):
    with stock_like(after(60, last, pack({"actions": [[0]]}))) as url:
        said = evaluate("--policy", url, "--seeds", 50, "--out", tmp_path / "e", code=5)
    error = said.err.splitlines()
    assert text in error[-1]
    assert "is kept" in error[-2]
    assert len((tmp_path / "e" / "rows.jsonl").read_text().splitlines()) > 2


def test_the_policy_of_the_tutorial_stands_where_its_table_says(law, tmp_path):
    path = law(blocks("tutorials/policy", "python")[1])
    setup = EvalSetup("CartPole-v1", path, link="lte", success_at=500)
    names = ("newest", "time-indexed", "broker")
    verdicts = [play(Episode(100.0, name, 1), setup)["verdict"] for name in names]
    assert verdicts == ["failure", "success", "failure"]
