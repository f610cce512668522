# SPDX-License-Identifier: Apache-2.0

"""A link between any environment and its policy: ticks, delays, repeatability, bad input."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import SyncVectorEnv

from cloudrc.base.errors import BadInputError
from cloudrc.gym import Networked, NetworkedVector
from cloudrc.gym.doubts import LinkWarning
from cloudrc.gym.linear import Linear
from cloudrc.gym.values import copied
from tests.gym.envs import Counter, Mixed, both_ways, told
from tests.support.programs import loaded
from tests.tensors import KINDS, Tensor

SHAKY = both_ways(70, 50, jitter_ms=40, loss=0.1)


def equal(one, other):
    """Return whether two nested values are equal bit by bit."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(equal, one, other))
    one, other = np.asarray(one), np.asarray(other)
    return one.dtype == other.dtype and one.tobytes() == other.tobytes()


@pytest.mark.parametrize("make", [lambda: gymnasium.make("InvertedPendulum-v5"), Mixed])
def test_an_ideal_link_changes_no_bit(make):
    bare, env = make(), Networked(make())
    bare.action_space.seed(7)
    assert equal(bare.reset(seed=3)[0], env.reset(seed=3)[0])
    for _ in range(60):
        action = bare.action_space.sample()
        expected, found = bare.step(action), env.step(action)
        link = found[4].pop("cloudrc")
        assert equal(expected, found)
        assert (link["observation_age"], link["action_age"], link["held"]) == (0.0, 0.0, False)
        if expected[2] or expected[3]:
            break


def test_a_seed_of_the_environment_selects_the_network_and_later_episodes_have_others():
    def losses(env, seed):
        return [each["lost_uplink"] for each in told(env, 100, seed)]

    env = Networked(Counter(), SHAKY, 1)
    first, second, again = losses(env, 3), losses(env, None), losses(env, 3)
    assert first == again != second
    assert losses(env, None) == second
    assert losses(env, 4) != first
    assert losses(Networked(Counter(), SHAKY, 1, stream="b"), 3) != first


def executed(link, **options):
    """Return the actions of a policy that sends 1, 2, 3..., as the robot executes them."""
    env = Networked(Counter(), link, **options)
    env.reset()
    for n in range(1, 7):
        env.step(np.array([n], np.float32))
    return [float(each[0]) for each in env.unwrapped.executed]


@pytest.mark.parametrize("way", [{"jitter_ms": 9, "keep_order": True}, {"rate_kbit": 90}])
def test_a_seed_repeats_the_network_also_if_packets_act_on_those_behind_them(way):
    """Without it, packets of the new episode wait behind those of the old one."""
    env = Networked(Counter(limit=50), {"uplink": {"delay_ms": 20, **way}})
    answer = np.zeros(env.action_space.shape, np.float32)

    def ages():
        env.reset(seed=3)
        return [env.step(answer)[-1]["cloudrc"]["observation_age"] for _ in range(50)]

    assert ages() == ages()


def test_without_an_answer_the_robot_repeats_its_action_or_executes_start():
    silent = {"downlink": {"blackouts": [{"start_s": 0.02, "duration_s": 0.02}]}}
    assert executed(silent) == [1, 2, 2, 2, 5, 6]
    assert executed(silent, hold="start") == [1, 2, 0, 0, 5, 6]
    again = executed(silent, hold="start", start=np.array([9], np.float32))
    assert again == [1, 2, 9, 9, 5, 6]


def test_the_end_of_an_episode_is_told_at_once_with_asked_against_measured():
    env = Networked(Counter(limit=400), SHAKY, 1)
    env.reset()
    ended = False
    while not ended:
        observation, reward, ended, _, info = env.step(np.zeros(1, np.float32))
    assert (reward, env.world_info) == (400.0, {"count": 400})
    assert observation[0] < 400
    summary = info["cloudrc"]["episode"]
    assert summary["ticks"] == 400
    for way, delay in (("uplink", 0.07), ("downlink", 0.05)):
        found = summary[way]
        assert found["delay_asked"] == pytest.approx(delay, abs=1e-3)
        assert found["delay_measured"] == pytest.approx(delay, abs=5e-3)
        assert found["loss_asked"] == pytest.approx(0.1, abs=0.01)
        assert found["loss_measured"] == pytest.approx(0.1, abs=0.05)
    assert summary["observation_age_mean"] > 0.04
    assert summary["action_age_mean"] > 0.09


def test_ages_and_the_worst_window_of_late_steps_and_of_steps_without_a_new_action():
    """Ages: 1 step up to step 13, 2 and 3 without an answer, again 1 up to 30, then 2.

    A peak is an age before that of a fresher observation: 25 times 1, 3, and 8 times 2 steps.
    """
    silent = {"delay_ms": 10, "blackouts": [{"start_s": 0.13, "duration_s": 0.02}]}
    late = {"changes": [{"at_s": 0.3, "delay_ms": 20}]}
    link = {"downlink": {**silent, **late}}

    def flown(deadline):
        return told(Networked(Counter(limit=40), link, 1, deadline=deadline), 40)[-1]["episode"]

    found = flown(0.015)
    assert found["age_counts"] == [0, 27, 10, 1]
    names = ("action_age_mean", "action_age_max", "action_age_peak_mean", "observation_age_max")
    assert [found[name] for name in names] == pytest.approx([0.5 / 38, 0.03, 0.44 / 34, 0.0])
    assert found["late_share"] == pytest.approx(11 / 38)
    missed = [flown(deadline)["misses_in_10"] for deadline in (1.0, 0.015, 0.005)]
    assert missed == [2, 9, 10]


@pytest.mark.filterwarnings("ignore::cloudrc.gym.doubts.LinkWarning")
def test_a_bottleneck_sees_the_sizes_of_observations_and_answers():
    slow = both_ways(0, 0, rate_kbit=1000)
    env = Networked(Counter(), slow, observation_bytes=10_000 - 28, action_bytes=2_500 - 28)
    assert told(env, 20)[-1]["observation_age"] == pytest.approx(0.18)  # 80 ms a packet: the second
    assert Networked(Counter(), slow)._loop._up._size == 8


@pytest.mark.filterwarnings("ignore::UserWarning")  # of the bare environments
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("Pendulum-v1", {"link": "lte", "compute": 0.02}),
        ("CartPole-v1", {"link": SHAKY, "chunk": 8, "executor": "prefix"}),
    ],
)
def test_gymnasium_accepts_the_wrapper_and_makes_it_again(name, options):
    env = Networked(gymnasium.make(name), **options)
    check_env(env, skip_render_check=True)
    again = gymnasium.make(env.spec)
    assert again.action_space == env.action_space
    env = gymnasium.make("cloudrc/Networked-v0", env=name, **options)
    check_env(env, skip_render_check=True)


def test_importing_the_wrapper_takes_no_heavy_package_along():
    heavy = {"pydantic", "mujoco", "cryptography", "yaml", "torch"}
    assert heavy & loaded("import cloudrc.gym") == set()


def test_an_argument_that_cannot_be_used_is_refused_in_one_line():
    words = "executor 'prefix': it plays chunks of actions; give chunk="
    with pytest.raises(BadInputError, match=words) as caught:
        Networked(Counter(), executor="prefix")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("env", "call"),
    [
        (Networked(Counter()), lambda env: env.step(np.zeros(1))),
        (Networked(Counter()), lambda env: env.summary()),
        (NetworkedVector(SyncVectorEnv([Counter])), lambda env: env.step(np.zeros((1, 1)))),
        (Linear(), lambda env: env.step(np.zeros(1))),
    ],
)
def test_whatever_needs_an_episode_says_reset_before_the_first(env, call):
    with pytest.raises(ResetNeeded, match=r"call reset\(\) before"):
        call(env)


@pytest.mark.parametrize(
    ("space", "executor"),
    [
        (spaces.Discrete(2), "ensemble"),
        (spaces.Discrete(2), "async"),
        (spaces.Box(0, 9, (2,), np.int64), {"name": "async", "aggregate": "average"}),
        (spaces.Dict(a=spaces.Box(0, 1, (1,))), "ensemble"),
    ],
)
def test_an_executor_that_computes_means_is_refused_for_other_actions(space, executor):
    with pytest.raises(BadInputError, match="must be floating-point numbers"):
        Networked(Counter(space), chunk=4, executor=executor)
    Networked(Counter(space), chunk=4, executor={"name": "async", "aggregate": "latest"})


LATE = both_ways(25, 20)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"compute": 20.0}, "an answer takes 20 s, an episode 5 s; times are in s"),
        ({"link": both_ways(4000, 4000)}, "an answer takes 8 s, an episode 5 s"),
        *(
            ({"link": LATE, "executor": name, "chunk": 1}, "choose executor 'newest'")
            for name in ("time_indexed", "ensemble", "prefix", "rtc", "async")
        ),
        ({"link": both_ways(90, 90), "executor": "prefix", "chunk": 3}, "few of them act, or none"),
    ],
)
def test_episodes_in_which_no_answer_acts_are_told_when_they_are_made(options, words):
    with pytest.warns(UserWarning, match=words):
        Networked(gymnasium.make("Pendulum-v1", 100), **options)
    with pytest.warns(UserWarning, match=words):
        NetworkedVector(gymnasium.make_vec("Pendulum-v1", 2, max_episode_steps=100), **options)


def test_a_link_of_a_function_is_judged_when_it_is_chosen_and_told_once():
    links = iter([both_ways(10, 10), both_ways(4000, 4000), both_ways(4000, 4000)])
    env = Networked(gymnasium.make("Pendulum-v1", 100), lambda seed: next(links))
    env.reset()
    with pytest.warns(LinkWarning, match="an answer takes 8 s, an episode 5 s"):
        env.reset()
    env.reset()


def test_what_can_act_is_not_told():
    for name in ("time_indexed", "ensemble", "prefix", "rtc", "async"):
        Networked(Counter(), LATE, chunk=6, executor=name, compute=0.004)
    Networked(gymnasium.make("Pendulum-v1", 100), LATE, compute=2.0)


def test_robots_that_meet_one_network_are_told_once_and_streams_part_them():
    def begin(robots):
        for env in robots:
            env.reset()
        for env in robots:
            env.step(np.zeros(1))

    with pytest.warns(UserWarning, match="seed=77 and stream='' meet one network") as told_once:
        begin([Networked(Counter(), SHAKY, 77) for _ in range(4)])
    assert len(told_once) == 1
    begin([Networked(Counter(), SHAKY, 78, stream=f"robot{n}") for n in range(4)])
    begin([Networked(Counter(), LATE, 79) for _ in range(2)])  # no number is drawn
    for _ in range(2):  # one after the other, as an experiment's conditions
        begin([Networked(Counter(), SHAKY, 80)])


class Pond:
    """No environment of gymnasium."""

    observation_space = action_space = None


@pytest.mark.parametrize(
    ("wrap", "env", "words"),
    [
        (Networked, SyncVectorEnv([Counter]), "give it to NetworkedVector"),
        (NetworkedVector, Counter(), "give it to Networked"),
        (Networked, Pond(), "Pond is no environment of gymnasium; wrap"),
        (
            Networked,
            type("Waterworld", (Pond,), {"__module__": "pettingzoo.sisl.waterworld"})(),
            "Waterworld is no environment of gymnasium but one of PettingZoo, in which several",
        ),
    ],
)
def test_what_is_no_environment_of_this_kind_is_refused_by_its_name(wrap, env, words):
    with pytest.raises(BadInputError, match=words):
        wrap(env)


def test_an_argument_of_the_environment_has_a_place_of_its_own():
    with pytest.raises(BadInputError, match=r"no argument of cloudrc/Networked-v0.*'g'.*env_args"):
        gymnasium.make("cloudrc/Networked-v0", env="Pendulum-v1", link="lte", g=9.0)


@pytest.mark.parametrize(("chunk", "action"), [(None, np.array([np.nan])), (4, np.zeros((3, 1)))])
def test_only_an_action_of_the_space_reaches_the_world(chunk, action):
    env = Networked(Counter(), chunk=chunk)
    env.reset()
    with pytest.raises(BadInputError, match=r"^[^\n]*the action: it is[^\n]*$"):
        env.step(action)
    assert env.unwrapped.executed == []


class Told(spaces.Box):
    """A space that counts how often its text is made."""

    texts = 0

    def __repr__(self):
        self.texts += 1
        return super().__repr__()


def test_the_text_of_a_space_which_takes_long_is_made_only_for_an_error():
    space = Told(-1, 1, (1,))
    env = Networked(Counter(space))
    env.reset()
    before = space.texts
    env.step(np.zeros(1))
    assert space.texts == before
    with pytest.raises(BadInputError, match=r"give one action, in Box\(-1"):
        env.step(np.zeros(2))


@pytest.mark.parametrize("kind", [np.float32, object])
def test_what_world_and_policy_keep_is_not_what_the_other_changes(kind):
    numbers = np.array([1.0, 2.0], kind)
    kept = copied({"a": numbers, "b": (numbers, "text", np.float32(3.0))})
    numbers[:] = 9.0
    assert [*map(list, (kept["a"], kept["b"][0]))] == [[1.0, 2.0]] * 2
    assert kept["a"].dtype == kind
    assert kept["b"][1:] == ("text", 3.0)


@pytest.mark.parametrize(
    ("space", "action"), [(spaces.Box(-1, 1, (1,)), [5.0]), (spaces.MultiBinary(2), [True, False])]
)
def test_a_value_beyond_its_bounds_and_truth_values_are_actions(space, action):
    env = Networked(Counter(space))
    env.reset()
    env.step(np.array(action))


@pytest.mark.parametrize("make_copy", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])  # noqa: S301
@pytest.mark.parametrize(
    "options",
    [
        {"compute": (0.02, 0.01)},
        {"chunk": 8, "executor": "prefix", "start": "answer"},
        {"delivery": "stream", "observation_bytes": 5_000},
    ],
)
def test_a_copy_within_an_episode_continues_bit_by_bit(make_copy, options):
    """As a policy that plans needs it, with packets in flight."""
    env = Networked(gymnasium.make("Pendulum-v1", max_episode_steps=60), "lossy", 3, **options)
    env.action_space.seed(1)

    def fly(world, answers):
        told = []
        for answer in answers:
            told.append(world.step(answer))
            if told[-1][3]:
                told.append(world.reset())
        return repr(told)

    env.reset(seed=2)
    before, after = ([env.action_space.sample() for _ in range(n)] for n in (20, 100))
    fly(env, before)
    other = make_copy(env)
    assert fly(other, after) == fly(env, after)


@pytest.mark.parametrize("kind", KINDS)
def test_a_tensor_is_an_action_and_may_be_an_observation(kind):
    class Torch(Counter):
        def reset(self, **given):
            observation, info = super().reset(**given)
            return Tensor(observation, **kind), info

        def step(self, action):
            observation, *rest = super().step(action)
            return Tensor(observation.copy(), **kind), *rest

    env = Networked(Torch(), chunk=2)
    env.reset()
    assert env.step(Tensor([[0.5], [0.0]], **kind))[0].detach().cpu().float().numpy() == [1.0]
    assert env.unwrapped.executed[0].tolist() == [0.5]
    envs = NetworkedVector(SyncVectorEnv([Counter, Counter]))
    envs.reset()
    envs.step(Tensor([[0.5], [0.25]], **kind))
    assert [each.executed[0].tolist() for each in envs.env.envs] == [[0.5], [0.25]]


@pytest.mark.parametrize("space", [spaces.Discrete(5), spaces.Box(-9.0, 9.0, (2,))])
def test_the_policy_may_observe_the_age_and_its_own_last_actions(space):
    memory = {"observe_age": True, "observe_actions": 3, "observe_step": True}
    env = Networked(Counter(space), both_ways(10, 20), start="answer", **memory)
    answers = [np.full(space.shape, n + 1, space.dtype)[()] for n in range(4)]
    nothing = np.zeros((3, *space.shape)).tolist()
    assert env.reset()[0]["actions"].tolist() == nothing
    for answer in answers[:2]:  # the first observation is asked for, and none in the next tick
        seen, *_ = env.step(answer)
        assert env.observation_space.contains(seen)
    assert seen["actions"][-1].tolist() == answers[0].tolist()
    assert seen["observation"] == [1.0]
    assert (seen["age"], seen["step"]) == (pytest.approx(0.01), 1.0)
    for answer in answers[2:]:
        seen, *_ = env.step(answer)
    assert seen["actions"].tolist() == [answers[n].tolist() for n in (0, 2, 3)]
    assert env.reset()[0]["actions"].tolist() == nothing
