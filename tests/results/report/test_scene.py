# SPDX-License-Identifier: Apache-2.0

"""The 3-D scene: its colours, and the nodes that it shows."""

import matplotlib
import numpy as np
import pytest
import viser

from cloudrc.config.load import load_experiment
from cloudrc.physics.geometry.clearance import CLEARANCE_SHOWN
from cloudrc.results.report.scene import FlightScene, clearance_colours
from cloudrc.results.report.shapes import read_shapes


@pytest.fixture
def server():
    one = viser.ViserServer("127.0.0.1", 0, verbose=False)
    yield one
    one.stop()


def shown(server, name, *sets):
    """Show an experiment; return the scene, and its nodes by name."""
    experiment = load_experiment(name, sets)
    world = experiment.world
    scene = FlightScene(server, experiment, read_shapes(world), world.files.scene)
    return scene, server.scene._handle_from_node_name


def test_the_trail_has_the_colours_of_the_figures():
    share = np.linspace(0.0, 1.25, 60)
    asked = matplotlib.colormaps["viridis"](share)[:, :3] * 255
    assert np.abs(clearance_colours(share * CLEARANCE_SHOWN) - asked).max() < 20


@pytest.mark.parametrize("name", ["paper", "hover"])
def test_the_scene_has_the_bodies_of_the_experiment(server, name):
    nodes = shown(server, name)[1].keys()
    assert {"/floor", "/robot/0", "/ghost/0"} <= nodes
    pipes = {node.split("/")[1] for node in nodes if node.endswith("/wall")}
    assert pipes == ({"pipe_1", "pipe_2", "pipe_3"} if name == "paper" else set())
    assert ("/board/0" in nodes) == (name == "paper")


def test_another_mission_replaces_waypoints_and_trail(server):
    (scene, handles), points = shown(server, "hover"), np.eye(3)
    scene.set_waypoints(points, 1)
    scene.set_trail(points, np.array([0.1, np.inf, 0.3]))
    colours = [handles[f"/waypoints/{number}"].color for number in (1, 2, 3)]
    assert colours[0] != colours[1] == colours[2]
    scene.set_waypoints(points, 2)
    assert handles["/plan"].points.tolist() == [points[1:].tolist()], "the way ahead"
    scene.set_waypoints(points[:1], 0)
    scene.set_trail(points[:1], np.zeros(0))
    assert {"/waypoints/2", "/waypoints/2/label", "/trail", "/plan"}.isdisjoint(handles)
    assert handles["/waypoints/1"].color == colours[1]


@pytest.mark.parametrize("robot", ["pelican", "x2", "nano", "rover"])
def test_every_robot_has_its_own_shape_and_colours(server, robot):
    name = "pillars" if robot == "rover" else "hover"
    shapes = read_shapes(load_experiment(name, (f"world.robot={robot}",)).world)
    nodes = shown(server, name, f"world.robot={robot}")[1]
    meshes = [
        node for path, node in nodes.items() if path.startswith("/robot/") and "size" not in path
    ]
    assert len(meshes) == len({surface.rgba for surface in shapes.robot}) > 1
    corners = np.concatenate([mesh.vertices for mesh in meshes])
    assert 2 * np.linalg.norm(corners, axis=1).max() == pytest.approx(shapes.size, rel=1e-5)
