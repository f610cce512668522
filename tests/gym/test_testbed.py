# SPDX-License-Identifier: Apache-2.0

"""The testbed's robots as environments fly the true path of its flights, bit by bit."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import cloudrc
import cloudrc.gym
from cloudrc.base.errors import BadInputError
from cloudrc.gym import Networked
from cloudrc.results.record.columns import Recording

SHORT = {"mission": {"steps": {"count": 2}}}
NEAR = {"mission.waypoints": [{"position_m": [0.8, 0.6], "tolerance_m": 0.2, "dwell_s": 0.5}]}


@pytest.mark.parametrize(
    ("name", "options", "experiment", "settings"),
    [
        ("cloudrc/Steps-v0", {"settings": SHORT}, "steps", SHORT),
        pytest.param("cloudrc/Pipes-v0", {}, "paper", {}, marks=pytest.mark.full),
        ("cloudrc/Steps-v0", {"experiment": "pillars", "settings": NEAR}, "pillars", NEAR),
    ],
)
def test_the_same_actions_fly_the_true_path_of_a_flight(name, options, experiment, settings):
    flight = cloudrc.fly(experiment, {"link.profile": "ideal", **settings}, seed=3)
    env = Networked(gymnasium.make(name, **options), "ideal")
    observation, _ = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    sent = flight["/cmd_vel"]
    axes = 2 if experiment == "pillars" else 3
    for velocity, yaw_rate in zip(sent["command"], sent["yaw_rate"], strict=True):
        observation, reward, ended, _, info = env.step(np.array([*velocity[:axes], yaw_rate]))
        if ended:
            break
    assert ended
    assert (info["verdict"], info["is_success"]) == (flight.verdict, flight.verdict == "success")
    assert reward == -np.linalg.norm(observation[:3] - observation[13:16])
    truth = flight["/ground_truth"]
    flown = Recording(records=env.unwrapped.flight.store)["/ground_truth"]
    count = len(flown["stamp_ns"])
    assert count > len(truth["stamp_ns"]) - 20  # a flight goes on for up to 100 ms
    for column in ("position", "orientation_wxyz", "velocity", "angular_velocity_body"):
        assert truth[column][:count].tobytes() == flown[column].tobytes()


def test_a_robot_that_cannot_lift_off_is_judged_when_it_is_loaded():
    with pytest.raises(BadInputError, match=r"^--set: world\.plant: the thrust-to-weight ratio"):
        gymnasium.make("cloudrc/Steps-v0", settings={"world.plant.payload_kg": 9})


def test_network_and_cloud_of_an_experiment_are_left_out(tmp_path):
    mine = "mission: hover\nlink: {uplink: {delay_ms: 90}, downlink: {loss: 0.5}}\n"
    mine += "cloud: {compute_ms: 9, compute_deviation_ms: 3, clock_offset_s: 5, plan_s: 0.5}\n"
    (tmp_path / "mine.yaml").write_text(mine)
    env = gymnasium.make("cloudrc/Steps-v0", experiment=str(tmp_path / "mine.yaml"))
    env.reset(seed=1)
    before = env.unwrapped.flight.now_ns
    env.step(np.zeros(4))
    assert env.unwrapped.flight.cloud.telemetry.odometry.stamp_ns == before + 10_000_000


def test_an_action_of_none_sends_nothing_but_a_sign_of_life_in_100_ms():
    env = gymnasium.make("cloudrc/Steps-v0").unwrapped
    env.reset(seed=1)
    for _ in range(100):
        env.step(np.array([0.5, 0.0, 0.0, 0.0]))
    cloud = env.flight.cloud
    cloud.count_sent()
    before = cloud.counts["sent"]
    for _ in range(120):
        env.step(None)
    cloud.count_sent()
    assert 12 <= cloud.counts["sent"] - before < 20
    assert cloud.counts["commands_withheld"] == 120


@pytest.mark.filterwarnings("ignore::UserWarning")  # an observation has no bounds
def test_gymnasium_accepts_a_robot():
    check_env(gymnasium.make("cloudrc/Steps-v0").unwrapped, skip_render_check=True)


def test_the_numbers_have_the_experiments_own_metrics_and_a_failing_one_is_a_warning(tmp_path):
    (tmp_path / "mine.py").write_text("UNIT = 's'\ndef measure(flight):\n    return 1.5\n")
    (tmp_path / "odd.py").write_text("UNIT = 's'\ndef measure(flight):\n    return 1 / 0\n")
    own = {"report.metrics": [str(tmp_path / "mine.py"), str(tmp_path / "odd.py")]}
    env = gymnasium.make("cloudrc/Steps-v0", settings=own).unwrapped
    env.reset(seed=1)
    with pytest.warns(UserWarning, match="metric odd failed"):
        info = env._judge(env.flight)
    assert info["numbers"]["mine"] == 1.5
    assert "odd" not in info["numbers"]


def test_a_seed_selects_the_steps_and_a_flight_can_be_repeated():
    env = gymnasium.make("cloudrc/Steps-v0")

    def fly(seed):
        observation, _ = env.reset(seed=seed)
        rewards = [env.step(np.array([0.1, 0, 0.2, 0]))[1] for _ in range(50)]
        return observation.tolist(), rewards

    assert fly(1) == fly(1) != fly(2)
    assert env.reset(seed=1)[0].tolist() != env.reset()[0].tolist()
