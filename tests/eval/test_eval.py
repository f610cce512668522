"""Evaluations: episodes over a link, their rows, tables and pages."""

import json
import re
import shlex
import sys
from hashlib import sha256
from itertools import count
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from cloudrc.cli.main import main
from cloudrc.errors import BadInputError, CloudrcError
from cloudrc.eval import results
from cloudrc.eval.episode import as_actions, check_environment, play, width_of
from cloudrc.eval.setup import (
    Episode,
    EvalSetup,
    check_setup,
    heavy_loss,
    link_at,
    read_compute,
    read_env_args,
    read_mapped,
    read_times,
)
from cloudrc.policy.actions import PolicyAnswerError, read_actions
from cloudrc.policy.observation import Mapped, observe
from tests.policy.conftest import serving, stock_like

LAW = """
import numpy as np

def decide(x, speed, angle, turn):
    return int(10.0 * angle + 2.0 * turn + 0.1 * x + 0.3 * speed > 0.0)

def infer(observation):
    return {"actions": [[decide(*observation["observation/state"])]] * 2}
"""
SHAKY = """
import numpy as np
def infer(observation):
    x, y, speed = observation["observation/state"]
    return {"actions": np.full((3, 1), -2.0 * y - 0.5 * speed)}
"""


@pytest.fixture
def law(tmp_path):
    def write(source=LAW):
        path = tmp_path / "law.py"
        path.write_text(source)
        return str(path)

    return write


def bare(env_id, decide, seed):
    """Play without cloudrc; return the return and the hash of the world."""
    env, digest, total = gymnasium.make(env_id), sha256(), 0.0
    observation, _ = env.reset(seed=seed)
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
    path, episode = law(source), Episode(None, "newest", 3)
    rows = [play(episode, EvalSetup(env_id, path), {})]
    with serving(path) as url:
        rows.append(play(episode, EvalSetup(env_id, url), {}))
    for row in rows:
        assert (row["numbers"]["return"], row["records_sha256"]) == bare(env_id, decide, 3)


def test_a_long_round_trip_makes_the_pole_fall_and_the_ages_are_those_of_the_link(law):
    setup = EvalSetup("CartPole-v1", law(), success_at=500)
    near, far = (play(Episode(rtt, "newest", 1), setup, {}) for rtt in (0.0, 200.0))
    assert (near["verdict"], far["verdict"]) == ("success", "failure")
    assert near["numbers"]["observation_age"] == 0.0
    assert far["numbers"]["delay_measured_uplink"] == pytest.approx(0.1)
    assert far["numbers"]["delay_asked_uplink"] == pytest.approx(0.1)


def test_the_way_to_execute_chunks_decides(law):
    """A chunk that simulates its own actions stands if each action is executed in its step."""
    source = LAW + (
        "def infer(observation):\n"
        "    x, speed, angle, turn = observation['observation/state']\n"
        "    return {'actions': [[decide(x, speed, angle + i * 0.0, turn)] for i in range(8)]}\n"
    )
    setup = EvalSetup("CartPole-v1", law(source), success_at=500)
    rows = [play(Episode(0.0, name, 1), setup, {}) for name in ("newest", "broker")]
    assert [row["verdict"] for row in rows] == ["success", "failure"]
    ages = [row["numbers"]["observation_age"] for row in rows]
    assert ages[0] == 0.0 < ages[1]


@pytest.mark.parametrize("compute", [0.06, (0.06, 0.0), ("file", "times.csv")])
def test_the_time_for_an_answer_is_charged(law, compute, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "times.csv").write_text("answer,seconds\n1,0.06\n2,0.06\n")
    late = play(Episode(0.0, "newest", 1), EvalSetup("CartPole-v1", law(), compute=compute), {})
    now = play(Episode(0.0, "newest", 1), EvalSetup("CartPole-v1", law()), {})
    assert now["numbers"]["action_age"] == 0.0
    assert late["numbers"]["action_age"] > 0.03


def test_each_answer_takes_the_next_time_of_the_file(law, tmp_path):
    rows = []
    for times in ("0.04\n", "0\n0.08\n"):
        path = tmp_path / "times.csv"
        path.write_text(times)
        setup = EvalSetup("CartPole-v1", law(), compute=("file", str(path)))
        rows.append(play(Episode(0.0, "newest", 1), setup, {}))
    assert rows[0]["records_sha256"] != rows[1]["records_sha256"]


def test_a_measured_time_leaves_no_hash(law):
    setup = EvalSetup("CartPole-v1", law(), compute=("measured", ""))
    row = play(Episode(0.0, "newest", 1), setup, {})
    assert row["records_sha256"] == ""
    assert not setup.is_repeatable


def test_the_same_episode_repeats_bit_by_bit_and_another_seed_is_another(law):
    setup = EvalSetup("CartPole-v1", law(), link="lossy")
    first, again, other = (play(Episode(None, "newest", s), setup, {}) for s in (1, 1, 2))
    assert first == again
    assert first["records_sha256"] != other["records_sha256"]


class Task(gymnasium.Env):
    """Tells in one step that the task is done, under the key `key`."""

    dt = 0.1
    action_space = gymnasium.spaces.Box(-1, 1, (2,))
    observation_space = gymnasium.spaces.Dict({"eye": gymnasium.spaces.Box(0, 255, (2,), np.uint8)})
    metadata = {"render_modes": []}  # noqa: RUF012
    render_mode = None

    def __init__(self, key="success", fails=False):
        self.key, self.fails = key, fails

    def reset(self, *, seed=None, options=None):
        self.count = 0
        return {"eye": np.zeros(2, np.uint8)}, {}

    def step(self, action):
        if self.fails:
            raise RuntimeError("the simulator broke")
        self.count += 1
        info = {self.key: np.float64(self.count == 3)}
        return {"eye": np.zeros(2, np.uint8)}, 1.0, self.count == 5, False, info


gymnasium.register("Task-v0", Task)
STILL = "def infer(observation):\n    return {'actions': [[0.0, 0.0]]}\n"


@pytest.mark.parametrize(
    ("key", "verdict"), [("success", "success"), ("is_success", "success"), ("other", "done")]
)
def test_a_success_is_what_the_info_says_in_any_step(law, key, verdict):
    setup = EvalSetup("Task-v0", law(STILL), (("key", key),))
    assert play(Episode(None, "newest", 1), setup, {})["verdict"] == verdict


@pytest.mark.parametrize(
    ("info", "verdict"),
    [
        ({"success": False, "is_success": True}, "success"),
        ({"success": True, "is_success": False}, "success"),
        ({"success": False, "is_success": False}, "failure"),
    ],
)
def test_one_of_two_keys_is_enough_for_a_success(law, monkeypatch, info, verdict):
    world = gymnasium.make("MountainCarContinuous-v0").unwrapped
    monkeypatch.setattr(type(world), "step", lambda env, _: (env.state, 0.0, True, False, info))
    policy = law("def infer(o): return {'actions': [[0.0]]}")
    setup = EvalSetup("MountainCarContinuous-v0", policy, dt=0.1)
    assert play(Episode(None, "newest", 1), setup, {})["verdict"] == verdict


def test_a_choice_that_the_environment_has_not_is_the_policys(law):
    policy = law("def infer(o): return {'actions': [[1], [2]]}")
    setup = EvalSetup("CartPole-v1", policy)
    with pytest.raises(CloudrcError, match=r"policy '.*': the action 2 is none of Discrete\(2\)"):
        play(Episode(None, "newest", 1), setup, {})


class Tenths(Task):
    """Gives ten rewards of 0.1, whose sum is 0.9999999999999999."""

    def step(self, action):
        observation, _, _, *others = super().step(action)
        return observation, 0.1, self.count == 10, *others


gymnasium.register("Tenths-v0", Tenths)


@pytest.mark.parametrize(("least", "verdict"), [(1.0, "success"), (1.0000001, "failure")])
def test_a_return_that_equals_the_limit_up_to_rounding_is_a_success(law, least, verdict):
    setup = EvalSetup("Tenths-v0", law(STILL), success_at=least)
    assert play(Episode(None, "newest", 1), setup, {})["verdict"] == verdict


def test_a_share_in_the_info_is_no_success_and_does_not_count_beside_a_limit(law, monkeypatch):
    told = {"success": 0.5}
    monkeypatch.setattr(Task, "step", lambda env, _: (env.reset()[0], 1.0, True, False, told))
    with pytest.raises(BadInputError, match=r"float 0\.5, .*--success-at"):
        play(Episode(None, "newest", 1), EvalSetup("Task-v0", law(STILL)), {})
    setup = EvalSetup("Task-v0", law(STILL), success_at=1.0)
    assert play(Episode(None, "newest", 1), setup, {})["verdict"] == "success"


class Seeing(Task):
    """Has an image of 1 MB, 0.8 s on the 10 Mbit/s of the profile lte."""

    observation_space = gymnasium.spaces.Dict(
        {
            "eye": gymnasium.spaces.Box(0, 255, (1000, 1000), np.uint8),
            "arm": gymnasium.spaces.Box(-1, 1, (4,)),
        }
    )

    def reset(self, *, seed=None, options=None):
        super().reset()
        return {"eye": np.zeros((1000, 1000), np.uint8), "arm": np.zeros(4, np.float32)}, {}

    def step(self, action):
        return self.reset()[0], *super().step(action)[1:]


gymnasium.register("Seeing-v0", Seeing)


def test_the_size_on_the_wire_is_that_of_the_policys_observation_or_the_given_one(law):
    def delay(**more):
        setup = EvalSetup("Seeing-v0", law(STILL), link="lte", max_steps=3, **more)
        return play(Episode(None, "newest", 1), setup, {})["numbers"]["delay_measured_uplink"]

    assert delay() > 0.8
    assert delay(mapped=(Mapped("state", "arm"),)) < 0.2
    assert delay(observation_bytes=1_000) < 0.2


class Random(Task):
    """Begins differently each time, unless it gets a seed."""

    starts = count()

    def __init__(self, seed=None):
        super().__init__()
        start = next(self.starts) if seed is None else seed
        self.start = np.full(2, start % 200, np.uint8)

    def reset(self, *, seed=None, options=None):
        return {"eye": self.start}, super().reset()[1]


gymnasium.register("Random-v0", Random)


def test_an_environment_that_does_not_follow_its_seed_is_told_and_may_get_it(law, tmp_path, capsys):
    words = ["eval", "--env", "Random-v0", "--policy", law(STILL), "--seeds", "1", "--jobs", "1"]
    for name, more, warned in (("a", [], True), ("b", ["--env-arg", "seed={seed}"], False)):
        assert main([*words, *more, "--out", str(tmp_path / name)]) == 0
        assert ("not paired" in capsys.readouterr().err) is warned
        page = (tmp_path / name / "report.html").read_text()
        assert ("not paired" in page) is warned
        document = json.loads((tmp_path / name / "eval.json").read_text())
        assert document["repeatable"] is not warned


def test_an_episode_without_an_end_is_cut(law):
    setup = EvalSetup("Pendulum-v1", law(SHAKY), max_steps=7)
    assert play(Episode(None, "newest", 1), setup, {})["numbers"]["steps"] == 7


def test_a_failing_environment_is_one_line(law):
    setup = EvalSetup("Task-v0", law(STILL), (("fails", True),))
    with pytest.raises(BadInputError, match=r"episode failed: test_eval\.py:.*: the simulator"):
        play(Episode(None, "newest", 1), setup, {})


@pytest.mark.parametrize(
    ("told", "words"),
    [
        ((np.nan, True, False, {}), "its reward is nan"),
        (("1.0", True, False, {}), "its reward is str '1.0', which is no number"),
        ((0.0, "False", False, {}), "its terminated is str 'False', which is no boolean"),
        ((0.0, True, None, {}), "its truncated is NoneType None, which is no boolean"),
        ((0.0, False, np.array([True, False]), {}), "its truncated is ndarray"),
        ((0.0, True, False, {"success": np.nan}), r"its info\['success'\] is float nan"),
        ((0.0, True, False, {"success": 0.5}), r"its info\['success'\] is float 0\.5"),
        ((0.0, True, False, {"success": [True, False]}), r"is list \[True, False\], which is no"),
        ((0.0, True, False, {"is_success": "False"}), r"its info\['is_success'\] is str 'False'"),
        ((0.0, True, False, None), "its info is NoneType None, which is no mapping"),
        ((True, np.True_, np.array([False]), {"success": np.array([1.0])}), None),
        ((True, 1, 0, {"success": np.float32(1)}), None),
    ],
)
def test_a_wrong_value_of_an_environment_is_no_success(law, monkeypatch, told, words):
    world = gymnasium.make("MountainCarContinuous-v0").unwrapped
    monkeypatch.setattr(type(world), "step", lambda env, action: (env.state, *told))
    setup = EvalSetup(
        "MountainCarContinuous-v0", law("def infer(o): return {'actions': [[0.0]]}"), dt=0.1
    )
    if words is None:
        assert play(Episode(None, "newest", 1), setup, {})["verdict"] == "success"
        return
    with pytest.raises(BadInputError, match=words):
        play(Episode(None, "newest", 1), setup, {})


ENDING = """
import argparse
import sys

import gymnasium

def end(place):
    if place == PLACE:
        END

end("import")

class Ending(gymnasium.Env):
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
    observation_space = gymnasium.spaces.Discrete(2)

    def __init__(self):
        end("init")

    def reset(self, *, seed=None, options=None):
        end("reset")
        return 0, {}

    def step(self, action):
        end("step")
        return 0, 1.0, True, False, {}

    def close(self):
        end("close")

gymnasium.register("Ending-v0", Ending)
"""


@pytest.mark.parametrize(
    ("place", "end"),
    [
        ("import", "argparse.ArgumentParser().parse_args(['x'])"),
        *((place, "sys.exit(0)") for place in ("import", "init", "reset", "step", "close")),
    ],
)
def test_an_environment_that_ends_itself_is_one_line_with_its_file(
    law, tmp_path, monkeypatch, capsys, place, end
):
    source = ENDING.replace("PLACE", repr(place)).replace("END", end)
    (tmp_path / "ending.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "ending", raising=False)
    monkeypatch.delitem(gymnasium.registry, "Ending-v0", raising=False)
    words = ["--policy", law(STILL), "--dt", "0.1", "--seeds", "1", "--out", str(tmp_path / "out")]
    assert main(["eval", "--env", "ending:Ending-v0", *words]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "--env ending:Ending-v0" in error
    assert "ending.py:9: " in error
    assert "sys.exit() was called" in error


def test_spaces_without_numbers_are_refused_and_whole_numbers_are_integers():
    with pytest.raises(BadInputError, match="Dict"):
        width_of(gymnasium.spaces.Dict({}))
    discrete = gymnasium.spaces.Discrete(3)
    assert as_actions(np.array([[1.0], [2.0]]), discrete).tolist() == [1, 2]
    integers = gymnasium.spaces.Box(0, 9, (1,), np.int8)
    assert as_actions(np.array([[1.0]]), integers).tolist() == [[1]]


@pytest.mark.parametrize(
    ("action", "dtype"),
    [(1e30, np.float16), (300, np.int8), (-1.0, np.uint8), (1e20, np.int64), (0.5, np.int64)],
)
def test_an_action_that_the_type_of_the_space_cannot_hold_is_wrong(action, dtype):
    with pytest.raises(PolicyAnswerError, match=re.escape(f"{action:g} does not fit")):
        as_actions(np.array([[action]]), gymnasium.spaces.Box(0, 1, (1,), dtype))


@pytest.mark.parametrize("action", [True, np.True_, "1", None, 1e300, 1j, np.timedelta64(1)])
def test_no_number_is_an_action_among_numbers(action):
    for answer in ([[0.5, action]], np.array([[0.5, action]], dtype=object)):
        with pytest.raises(PolicyAnswerError, match=r"value at \[0, 1\]"):
            read_actions({"actions": answer}, may_switch=True)


def test_only_actions_that_are_no_reals_may_be_booleans(law):
    path = law("def infer(observation):\n    return {'actions': [[True]]}\n")
    row = play(Episode(None, "newest", 1), EvalSetup("CartPole-v1", path), {})
    assert row["numbers"]["steps"] > 5
    with pytest.raises(CloudrcError, match=r"value at \[0, 0\] is bool True"):
        play(Episode(None, "newest", 1), EvalSetup("Pendulum-v1", path), {})


def test_the_jump_between_two_choices_that_are_booleans_is_1(law, tmp_path):
    executor = tmp_path / "switch.py"
    executor.write_text(
        "from cloudrc.gym.executors.newest import Newest\n"
        "class Switch(Newest):\n"
        "    def action(self, tick):\n"
        "        return bool(super().action(tick)) ^ bool(tick % 2)\n"
        "build = Switch\n"
    )
    row = play(Episode(None, str(executor), 1), EvalSetup("CartPole-v1", law(), max_steps=9), {})
    assert 0.0 < row["numbers"]["seam_jump"] <= 1.0


def test_the_map_makes_the_policys_observation(tmp_path):
    path = tmp_path / "map.yaml"
    path.write_text("observation/state: robot.pose\nprompt: {value: go}\nall: .\n")
    mapped, seen = read_mapped(path), {"robot": {"pose": [1.0]}}
    assert observe(seen, mapped) == {"observation/state": [1.0], "prompt": "go", "all": seen}
    with pytest.raises(BadInputError, match=r"no 'eye\.left'; there are robot"):
        observe(seen, [Mapped("x", "eye.left")])
    for wrong in ("x: 3\n", "{}\n", "x: {path: y}\n"):
        path.write_text(wrong)
        with pytest.raises(BadInputError, match="for example"):
            read_mapped(path)


def test_without_a_map_an_observation_keeps_its_keys():
    assert observe({"eye": 1}) == {"eye": 1}
    assert observe([1.0]) == {"observation/state": [1.0]}


def test_a_round_trip_keeps_the_ratio_of_the_profile():
    link = link_at("lte", 100.0)
    assert (link.uplink.delay_ms, link.downlink.delay_ms) == (60.0, 40.0)
    assert (link.uplink.jitter_ms, link.uplink.loss) == (8, 0.002)
    none, even = link_at("lte", 0.0), link_at("ideal", 80.0)
    assert (none.uplink.delay_ms, none.uplink.jitter_ms) == (0.0, 0.0)
    assert (even.uplink.delay_ms, even.downlink.delay_ms) == (40.0, 40.0)
    with pytest.raises(BadInputError, match="change over time"):
        link_at("handover", 80.0)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("0.02", 0.02),
        ("0.05,0.02", (0.05, 0.02)),
        ("measured", ("measured", "")),
        ("a.csv", ("file", "a.csv")),
    ],
)
def test_a_time_for_an_answer_is_read(text, found, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("a.csv").touch()
    assert read_compute(text) == found


@pytest.mark.parametrize("text", ["-1", "1,2,3", "nan", "inf", "50ms", "0.05,x", "absent.csv", ""])
def test_a_wrong_time_for_an_answer_is_refused_with_all_that_fits(text):
    with pytest.raises(
        BadInputError, match=r"--compute.* 0\.05, MEAN,DEVIATION .* file .*measured"
    ):
        read_compute(text)


@pytest.mark.parametrize(("loss", "warned"), [(1, True), (0.01, False)])
def test_a_loss_that_may_be_meant_in_percent_is_a_warning(loss, warned, tmp_path):
    (tmp_path / "lab.yaml").write_text(f"uplink: {{delay_ms: 40, loss: {loss}}}\n")
    setup = EvalSetup("CartPole-v1", "law.py", link=str(tmp_path / "lab.yaml"))
    said = [text for text in heavy_loss(setup) if "the uplink loses 100 %" in text]
    assert bool(said) is warned


@pytest.mark.parametrize(
    ("compute", "warned"),
    [(50.0, True), ((50.0, 1.0), True), (0.5, False), (("measured", ""), False)],
)
def test_an_answer_that_takes_very_many_steps_is_a_warning(law, compute, warned):
    setup = EvalSetup("CartPole-v1", law(), compute=compute)
    found = check_environment(setup, []).step.doubts
    assert [text.partition(";")[0] for text in found] == [
        "compute: an answer takes 50 s, as long as 2,500 steps of the environment"
    ] * warned


def test_a_time_of_a_step_in_another_unit_is_one_warning(law, tmp_path, capsys):
    line = f"eval --env CartPole-v1 --policy {law()} --seeds 2 --jobs 1 --dt 20 --out {tmp_path}/a"
    assert main(line.split()) == 0
    said = [each for each in capsys.readouterr().err.splitlines() if "warning" in each]
    about = "--dt: a step of 20 s, but the environment says 0.02 s; the unit is s"
    assert said == [f"cloudrc: warning: {about}"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        *(("", "no times"), ("x\n", "no times"), ("nan\n", "line 1: 'nan'"), ("\xff", "no times")),
        *(("x\n\n1\nx\n", "line 4: 'x'"), ("1\n-1\n", "line 2: '-1'"), ("1\n1,\n", "line 2: ''")),
        *(("0.1\n1_0\n", "line 2: '1_0'"), ("a,1_0\n1\n", "line 1: '1_0'"), ("5ms\n1\n", "line 1")),
        ("\x00", "not a text file"),
    ],
)
def test_a_wrong_file_of_times_is_refused(law, tmp_path, content, words):
    path = tmp_path / "times.csv"
    path.write_bytes(content.encode("latin-1"))
    with pytest.raises(BadInputError, match=f"^--compute {path}.*{words}"):
        check_setup(EvalSetup("CartPole-v1", law(), compute=("file", str(path))))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_a_file_of_times_has_any_usual_encoding(tmp_path, encoding):
    path = tmp_path / "times.csv"
    path.write_text('n,time\n1,0.5\n\n2, "0.25"\n', encoding=encoding)
    assert read_times(str(path)) == (0.5, 0.25)


@pytest.mark.parametrize("policy", ["no_such.py", "ws://", "http://h:1", "law"])
def test_a_policy_that_is_none_is_refused(policy):
    with pytest.raises(BadInputError, match="--policy"):
        check_setup(EvalSetup("CartPole-v1", policy))


def test_arguments_of_an_environment_are_yaml():
    assert read_env_args(["b=[1, 2]", "a=x"]) == (("a", "x"), ("b", [1, 2]))
    assert read_env_args(["seed={seed}", "c={at: [a, b]}"])[1] == ("seed", "{seed}")
    for wrong in ("a", "=1", "a b=1"):
        with pytest.raises(BadInputError, match="--env-arg"):
            read_env_args([wrong])


def run(*words):
    return main(["eval", "--env", "CartPole-v1", "--jobs", "1", *map(str, words)])


def test_an_evaluation_has_a_table_a_page_and_rows_and_continues(law, tmp_path, capsys):
    words = ["--policy", law(), "--rtt", "0,200", "--success-at", 500, "--out", tmp_path / "e"]
    assert run(*words, "--seeds", 2) == 0
    rows = (tmp_path / "e" / "rows.jsonl").read_text().splitlines()
    assert run(*words, "--seeds", 3, "-o", "json") == 0
    more = (tmp_path / "e" / "rows.jsonl").read_text().splitlines()
    assert (len(rows), len(more), more[:6]) == (6, 9, rows)
    document = json.loads(capsys.readouterr().out.partition("\n{")[2].join("{}")[:-1])
    bare, near, far = document["outcomes"]
    assert (near["successes"], near["episodes"], far["successes"]) == (3, 3, 0)
    assert near["success_low"] == pytest.approx(0.292, abs=0.001)
    assert (bare["executor"], bare["rtt_ms"], bare["success"]) == ("no network", None, 1.0)
    assert (near["truncated"], far["terminated"], far["limit"]) == (3, 3, 0)
    assert document["versions"]["gymnasium"] == gymnasium.__version__
    assert document["command"].startswith("cloudrc eval --env CartPole-v1")
    page = (tmp_path / "e" / "report.html").read_text()
    assert "<svg" in page
    assert "3/3" in page
    assert "http://www.w3.org" not in page.replace("http://www.w3.org/", "")


def test_rows_of_other_code_are_refused(law, tmp_path, capsys):
    words = ["--policy", law(), "--seeds", 1, "--out", tmp_path / "e"]
    assert run(*words) == 0
    path = tmp_path / "e" / "rows.jsonl"
    row = json.loads(path.read_text().splitlines()[0])
    path.write_text(json.dumps({**row, "code": "0" * 16}) + "\n")
    assert run(*words) == 2
    assert "000" in capsys.readouterr().err


def after(count, last):
    """Serve `LAW`'s first action `count` times, then `last`."""
    from cloudrc.policy.codec import pack

    left = iter(range(count))
    return lambda connection, frame: (
        pack({"actions": [[0]]}) if next(left, None) is not None else last
    )


@pytest.mark.parametrize(
    ("last", "text"),
    [
        ("ValueError: no", "ValueError: no"),
        (b"\x91\x01", "cannot be read"),
        (results.json.dumps({}).encode(), "cannot be read"),
    ],
)
def test_a_server_that_fails_keeps_the_rows_and_is_one_line(tmp_path, capsys, last, text):
    with stock_like(after(60, last)) as url:
        assert run("--policy", url, "--seeds", 50, "--out", tmp_path / "e") == 5
    error = capsys.readouterr().err.splitlines()
    assert text in error[-1]
    assert "rows are kept" in error[-2]
    assert len((tmp_path / "e" / "rows.jsonl").read_text().splitlines()) > 2


@pytest.mark.parametrize(
    ("answer", "text"),
    [
        ("[[float('nan')]]", "not finite"),
        ("[[1, 2]]", r"shape \(1, 2\)"),
        ("[1]", "shape"),
        ("[[1]] * count", "after 1"),
    ],
)
def test_wrong_actions_of_a_file_are_one_line(law, answer, text):
    source = "count = 0\ndef infer(o):\n    global count\n    count += 1\n"
    path = law(f"{source}    return {{'actions': {answer}}}\n")
    with pytest.raises(CloudrcError, match=text) as raised:
        play(Episode(None, "newest", 1), EvalSetup("CartPole-v1", path), {})
    assert raised.value.exit_code == 5


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--env", "NoSuch-v0"], "--env NoSuch-v0"),
        (["--env", "no_such_module:X-v0"], "no_such_module"),
        (["--env-arg", "nothing=1"], "nothing"),
        (["--executor", "no-such"], "no_such"),
        (["--executor", "newest,"], "--executor"),
        (["--rtt", "0,x"], "--rtt"),
        (["--rtt", "-1"], "--rtt"),
        (["--rtt", "1_0"], "--rtt"),
        (["--compute", "1_0"], "--compute"),
        (["--success-at", "nan"], "--success-at"),
        (["--link", "no-such"], "no-such"),
        (["--seeds", "0"], "--seeds"),
        (["--map", "no-such.yaml"], "no-such.yaml"),
    ],
)
def test_wrong_flags_are_one_line_and_leave_no_folder(law, tmp_path, capsys, words, text):
    assert run("--policy", law(), "--out", tmp_path / "e", *words) == 2
    assert text in capsys.readouterr().err.splitlines()[-1]
    assert not (tmp_path / "e").exists()


def test_the_policy_of_the_documentation_stands_where_the_table_says(law, tmp_path):
    text = (Path(__file__).parents[2] / "docs" / "eval.md").read_text()
    path = law(text.partition("```python\n")[2].partition("```")[0])
    setup = EvalSetup("CartPole-v1", path, link="lte", success_at=500)
    names = ("newest", "time-indexed", "broker")
    verdicts = [play(Episode(100.0, name, 1), setup, {})["verdict"] for name in names]
    assert verdicts == ["failure", "success", "failure"]


@pytest.mark.full
def test_the_command_of_the_documentation_prints_its_table(law, tmp_path, capsys, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "eval.md").read_text()
    law(text.partition("```python\n")[2].partition("```")[0])
    monkeypatch.chdir(tmp_path)
    command = text.partition("```bash\ncloudrc eval")[2].partition("```")[0]
    assert main(["eval", *shlex.split(command.replace("\\\n", " "))]) == 0
    table = text.partition("```text\n")[2].partition("```")[0].strip().splitlines()
    printed = capsys.readouterr().out.splitlines()
    start = printed.index(table[0])
    assert printed[start : start + len(table)] == table
