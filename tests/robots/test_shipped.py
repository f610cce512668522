# SPDX-License-Identifier: Apache-2.0

"""Each shipped multirotor flies the same missions over the same links."""

import numpy as np
import pytest

import cloudrc
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import find_robot
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.sim.airframe import read_airframe
from cloudrc.physics.sim.scene import compile_model
from cloudrc.robots.build import build_robot

STEPS = {"mission.steps.count": 3, "link.profile": "paper-p2"}


def test_other_multirotors_fly_steps_like_the_pelican():
    robots = "pelican", "nano", "x2"
    pelican, *others = (cloudrc.fly("steps", STEPS | {"world.robot": robot}) for robot in robots)
    for flight in (pelican, *others):
        assert flight.verdict == "success"
        assert flight.numbers["iae_mean"] < 1.3 * pelican.numbers["iae_mean"]
        assert flight.numbers["hold_count"] == 0


def test_a_model_alone_flies(tmp_path):
    """A user has an MJCF file of a multirotor, and no line of YAML."""
    model = tmp_path / "mine.xml"
    model.write_text(find_robot("x2").model.read_text().replace('mass="1.22"', 'mass="1.6"'))
    flight = cloudrc.fly("steps", STEPS | {"world.robot": str(model)})
    assert flight.verdict == "success"
    assert any("mine.xml alone, without a robot.yaml" in note for note in flight.notes)


@pytest.mark.parametrize("carrot", [None, {"speed_mps": 1.0}])
def test_a_drone_turns_the_short_way_to_the_yaws_of_its_waypoints(carrot):
    places = ((0.0, 170), (0.5, -170), (0.0, None))
    points = [{"position_m": [x, 0, 1], "yaw_deg": yaw} for x, yaw in places]
    mission = {"waypoints": points, "carrot": carrot}
    flight = cloudrc.fly("steps", {"world.robot": "x2", "mission": mission})
    assert (flight.verdict, flight.numbers["waypoints_reached"]) == ("success", 3)
    assert flight.numbers["yaw_error"] < 0.09
    w, x, y, z = flight["/ground_truth"]["orientation_wxyz"].T
    yaws = np.degrees(np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))))
    assert yaws[-1] == pytest.approx(190, abs=6)
    assert yaws.max() < 200


def test_the_rotors_of_the_nano_push_and_turn_as_those_of_a_crazyflie():
    """The firmware's mixer adds roll, pitch and yaw to the thrusts of its motors 1 to 4 so."""
    mixer = {
        "front_right": (-1, -1, -1),
        "back_right": (-1, 1, 1),
        "back_left": (1, 1, -1),
        "front_left": (1, -1, 1),
    }
    world = ResolvedWorld.model_validate({"robot": "nano", "scene": "empty"})
    robot = build_robot(world, ResolvedGuard.model_validate({}))
    frame = read_airframe(robot.simulator.model)
    roll, pitch, _, yaw = frame.wrench
    signs = np.sign([roll, pitch, yaw]).T.astype(int)
    assert dict(zip(frame.names, map(tuple, signs.tolist()), strict=True)) == mixer


def test_flights_of_a_sweep_share_the_compiled_model_as_copies(monkeypatch):
    """An onboard controller of a user may change the model that it gets."""
    compiled = []
    monkeypatch.setattr(
        "cloudrc.physics.sim.scene.compile_model",
        lambda *files: compiled.append(compile_model(*files)) or compiled[-1],
    )
    world, limits = ResolvedWorld.model_validate({"robot": "x2", "scene": "empty"}), ResolvedGuard()
    first, second = (build_robot(world, limits).simulator.model for _ in range(2))
    assert len(compiled) == 1
    first.body_mass[:] = 0.0
    assert second.body_mass.any()
    assert compiled[0].body_mass.any()
