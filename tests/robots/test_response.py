# SPDX-License-Identifier: Apache-2.0

"""Predictors with a model take it from the robot, or refuse the robot by name."""

import json

import pytest

import cloudrc
from cloudrc.base.errors import BadInputError
from cloudrc.cloud.results import is_ours
from cloudrc.config.choice import PlugIn
from cloudrc.config.overrides import build_plugin, onboard_values
from cloudrc.config.robot import facts, find_robot
from cloudrc.config.world import ResolvedWorld
from tests.conftest import nightly

GROUND = {"steps": {"count": 3, "centre_m": [0, 0, 0.1], "range_m": [1.5, 1.5, 0]}}
MODELS = ("command_history", "kalman", "model_based")


def build(robot, predictor, **keys):
    world = ResolvedWorld.model_validate_json(json.dumps({"robot": robot, **keys}))
    known = facts(world.files.robot, world, 7.0)
    return build_plugin("predictors", PlugIn.model_validate(predictor), robot=known)


@pytest.mark.parametrize("robot", ["nano", *nightly("rover")])
def test_a_predictor_with_the_robots_model_predicts_far_better_than_none(robot):
    keys = {"world.robot": robot, "link.profile": "paper-p3", "mission.steps.count": 2}
    if robot == "rover":
        keys |= {"mission": GROUND}
        del keys["mission.steps.count"]
    errors = {
        name: cloudrc.fly("steps", {**keys, "cloud.predictor": name}).numbers[
            "prediction_error_rms"
        ]
        for name in (*MODELS, "last_sample")
    }
    without = errors.pop("last_sample")
    assert max(errors.values()) < 0.3 * without, errors


def test_the_model_of_the_pelican_follows_its_onboard_controller():
    """Its parameters are those of tuning and world.onboard, unless the predictor has its own."""

    def limit(own=None, **keys):
        predictor = build("pelican", {"name": "model_based", **(own or {})}, **keys)
        return predictor._start.args[0][9]

    assert limit() == 0.1
    assert limit(tuning="fast") == 0.3
    assert limit(tuning="fast", onboard={"integral_limit_xy": 0.2}) == 0.2
    assert limit({"integral_limit_xy": 0.5}, tuning="fast") == 0.5


def test_the_response_belongs_to_a_tuning(own_robot):
    def response(constant):
        return f"{{time_constant: [{constant}, 1, 1], dead_time: [0, 0, 0], gain: [1, 1, 1]}}"

    tunings = f"{{a: {{tilt_max_deg: 20, response: {response(3)}}}, b: {{tilt_max_deg: 25}}}}"
    mine = own_robot(f"onboard: multirotor\nresponse: {response(2)}\ntunings: {tunings}")
    constants = {
        tuning: build(str(mine), {"name": "model_based"}, tuning=tuning)._axes[0][0]
        for tuning in (None, "a", "b")
    }
    assert constants == {None: 2.0, "a": 3.0, "b": 2.0}
    world = ResolvedWorld(robot=str(mine), tuning="a")
    assert onboard_values(world.files.robot, world)["tilt_max_deg"] == 20


def test_a_model_of_ones_own_may_lie_in_the_folder_and_gets_the_parameters(own_robot):
    mine = own_robot("onboard: {name: multirotor, tilt_max_deg: 20}\nmotion: ./own.py\n")
    (mine / "own.py").write_text(
        "def build(acceleration_max, tilt_max_deg=35.0):\n"
        "    raise ValueError(f'{acceleration_max:g} {tilt_max_deg:g}')\n"
    )
    with pytest.raises(BadInputError, match="7 20"):
        build(str(mine), {"name": "model_based"})
    (mine / "own.py").write_text("def build(acceleration_max, tilt_max_deg):\n    return print\n")
    for name in ("model_based", "kalman"):
        assert is_ours(build("pelican", {"name": name}))
        assert not is_ours(build(str(mine), {"name": name})), (
            "what a user's model returns is judged"
        )


def test_identify_writes_a_response_for_a_robot_on_the_ground(
    call, as_json, tmp_path, monkeypatch, no_page
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ground.yaml").write_text(json.dumps({
        "mission": GROUND | {"steps": GROUND["steps"] | {"count": 10}},
        "world": {"scene": "empty", "robot": "rover"}, "link": {"profile": "ideal"},
        "criteria": {"settle_m": None},
    }))  # fmt: skip
    call("run ground.yaml --mode virtual --out run")
    found = as_json("identify run")
    assert found["robot_yaml"] == "response"
    response = find_robot("rover").response
    assert found["gain"][2] == 0.0
    assert (found["explained"][2], found["half_width_95"]["gain"][2]) == (None, None)
    assert "stays on the ground" in call("identify run --out other.yaml").out
    assert found["gain"][:2] == pytest.approx(response.gain[:2], abs=0.1)
    delays = [sum(pair) for pair in zip(found["time_constant"], found["dead_time"], strict=True)]
    assert delays[:2] == pytest.approx([0.1, 0.1], abs=0.05)
