# SPDX-License-Identifier: Apache-2.0

"""The fence comes from the scene, or from world.fence_m; a wrong one is one line."""

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.config.load import load_experiment
from cloudrc.config.world import ResolvedWorld
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.obstacles import fence_of
from cloudrc.physics.geometry.scene import SCENES, load_scene
from cloudrc.robots.build import build_robot

NUMERIC = '<numeric name="fence" data="-3 -8.5 0  9.2 5.5 2.5"/>'
HOVER = "mission={waypoints: [{position_m: [0, 0, 1]}]}"


def fence_in(scene):
    """Return the fence of a scene."""
    return fence_of(ResolvedWorld(scene=scene).files.scene)


@pytest.fixture
def own(tmp_path):
    """Return a function that makes a scene with these bodies, and with a fence or without one."""

    def make(bodies="", fence="", spawn="0 0 .1"):
        text = (SCENES / "empty.xml").read_text()
        assert NUMERIC in text
        text = text.replace(NUMERIC, fence and f'<numeric name="fence" data="{fence}"/>')
        text = text.replace('pos="0 0 .1"', f'pos="{spawn}"')
        path = tmp_path / "lab.xml"
        path.write_text(text.replace("</worldbody>", f"{bodies}</worldbody>"))
        return str(path)

    return make


@pytest.mark.parametrize("name", ["empty", "pillars", "pipes"])
def test_the_shipped_scenes_declare_their_fence(name):
    assert load_scene(name).own_fence == Fence((-3.0, -8.5, 0.0), (9.2, 5.5, 2.5))


def test_the_fence_of_a_scene_without_one_is_3_m_around_spawn_and_geoms(own):
    boxes = '<body pos="4 1 1"><geom type="box" size=".5 .2 1" euler="0 0 90"/></body>'
    fence = fence_in(own(boxes))
    assert fence.low == pytest.approx((-3.0, -3.0, 0.0))
    assert fence.high == pytest.approx((7.2, 4.5, 5.0))
    assert fence_in(own()).high == pytest.approx((3.0, 3.0, 3.1))


def test_the_fence_begins_at_the_ground_below_the_spawn(own):
    raised = own('<body><geom type="box" size="1 1 .1" pos="0 0 .4"/></body>', spawn="0 0 .6")
    assert fence_in(raised).low[2] == pytest.approx(0.5)


def test_world_fence_m_replaces_the_fence_and_lowers_the_speed_cap():
    corners = "[[-1, -1, 0], [2, 1, 2]]"
    experiment = load_experiment("steps", ["world.fence_m=" + corners, HOVER])
    # The longest way from the spawn to a wall is 2 m: v 0.45 s + v^2 / 6 = 1.5 m
    assert experiment.guard.speed_max_mps == pytest.approx(1.9398, abs=1e-3)
    fence = build_robot(experiment.world, experiment.guard).guard.fence
    assert (fence.low, fence.high) == ((-1.0, -1.0, 0.0), (2.0, 1.0, 2.0))


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ("0 0 0 1 1", "fence: data must be 6 numbers"),
        ("-.1 -3 0 5 3 2", "the spawn.*too near to a wall; it may be at x 0.1 to 4.8"),
    ],
)
def test_a_wrong_fence_of_a_scene_is_one_line(own, numbers, words):
    with pytest.raises(BadInputError, match=words) as error:
        load_experiment("steps", [f"world.scene={own(fence=numbers)}", HOVER])
    assert "\n" not in str(error.value)


def test_a_wrong_world_fence_m_is_named():
    with pytest.raises(BadInputError, match=r"fence_m: .*x, y, z must rise"):
        load_experiment("steps", ["world.fence_m=[[3, 3, 2], [-3, -3, 0]]", HOVER])


def test_a_robot_on_the_ground_needs_no_height():
    low = "world.fence_m=[[-1, -1, 0], [2, 1, .3]]"
    way = "mission.waypoints=[{position_m: [1, 0]}]"
    load_experiment("pillars", ["world.scene=empty", low, way])
