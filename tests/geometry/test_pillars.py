"""The shipped scene `pillars`: its bodies are obstacles, and a drone flies between them."""

import pytest

import cloudrc
from cloudrc.geometry.scene import load_scene


@pytest.mark.parametrize("name", ["empty", "pipes"])
def test_a_scene_that_declares_all_its_bodies_is_read_without_mujoco(name):
    assert load_scene(name).path is None


def test_a_drone_flies_the_slalom_through_the_pillars():
    flight = cloudrc.fly("steps", {"mission": "slalom", "world.scene": "pillars"})
    assert flight.verdict == "success"
    assert flight.numbers["waypoints_reached"] == 5
    assert flight.numbers["obstacle_contacts"] == 0
