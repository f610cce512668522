"""The shipped scene `pillars`: its bodies are obstacles, and a drone flies between them."""

import pytest

import cloudrc
from cloudrc.config.load import load_experiment
from cloudrc.config.scene import scene_of
from cloudrc.config.schema import World
from cloudrc.errors import BadInputError
from cloudrc.geometry.obstacles import obstacles
from cloudrc.geometry.scene import load_scene


def test_all_bodies_of_a_shipped_scene_are_obstacles_also_without_numbers_in_its_file():
    scene = scene_of(World(scene="pillars"))
    found = {each.name for each in obstacles(scene, touch=None)}
    assert found == set(scene.bodies) - {"floor"}
    assert {"pillar_1", "pillar_4", "thick_left", "block"} <= found


@pytest.mark.parametrize("name", ["empty", "pipes"])
def test_a_scene_that_declares_all_its_bodies_is_read_without_mujoco(name):
    assert load_scene(name).path is None


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[3.4, 0.1, 1.0]], "pillar_2"),
        ([[3.5, 2.0, 1.0]], "thick_left"),
        ([[0.0, 0.0, 1.0], [9.0, 0.0, 1.0]], "through pillar_1"),
    ],
)
def test_a_waypoint_or_a_way_through_a_pillar_is_refused(points, message):
    waypoints = ", ".join(f"{{position_m: {point}}}" for point in points)
    with pytest.raises(BadInputError, match=message):
        load_experiment("steps", [f"mission={{waypoints: [{waypoints}]}}", "world.scene=pillars"])


def test_a_drone_flies_the_slalom_through_the_pillars():
    flight = cloudrc.fly("steps", {"mission": "slalom", "world.scene": "pillars"})
    assert flight.verdict == "success"
    assert flight.numbers["waypoints_reached"] == 5
    assert flight.numbers["obstacle_contacts"] == 0
