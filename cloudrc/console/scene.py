"""Show the robot and its surroundings in a browser: `FlightScene`, on viser and mjviser.

Only this module imports mjviser, which converts the shapes of the MuJoCo model to meshes.
"""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from cloudrc.config.schema import Experiment
from cloudrc.geometry.clearance import CLEARANCE_SHOWN, Array
from cloudrc.geometry.scene import Pipe, Scene, load_scene
from cloudrc.messages import Vector
from cloudrc.world.scene import ROBOT_PREFIX, ROTORS, compile_model, mujoco

Colour = tuple[int, int, int]
GHOST_COLOUR: Colour = (0, 114, 178)
SETPOINT_COLOUR: Colour = (213, 94, 0)
REACHED_COLOUR: Colour = (0, 158, 115)
OPEN_COLOUR: Colour = (255, 255, 255)
PIPE_COLOUR: Colour = (110, 130, 150)
ROD_COLOUR: Colour = (77, 77, 82)
"""Colours of the scene, those of the report's figures: blue is estimated, vermilion is asked."""
PIPE_OPACITY, GHOST_OPACITY = 0.5, 0.35
VIRIDIS = np.array(
    [
        *((68, 1, 84), (71, 45, 123), (59, 82, 139), (44, 114, 142), (33, 145, 140)),
        *((40, 174, 128), (94, 201, 98), (173, 220, 48), (253, 231, 37)),
    ]
)
"""Colour map of clearance, evenly spaced from 0 to `CLEARANCE_SHOWN`, as in the figures."""
STRUT_RADIUS = 0.006
"""Radius of the struts between rotors and base [m]. Only pictures show them."""


class FlightScene:
    """Robot, pipes, board and floor of an experiment in the scene of a viser server.

    The world frame of the scene is that of the flight [m]; its z axis points up.
    """

    def __init__(self, server: viser.ViserServer, experiment: Experiment) -> None:
        """Add the static shapes and the robot at its spawn.

        Raises:
            BadInputError: If robot or scene are missing or unsuitable.
        """
        self._scene, world = server.scene, experiment.world
        model, geometry = compile_model(world.robot, world.scene), load_scene(world.scene)
        self._scene.set_up_direction("+z")
        self._add_surroundings(model, geometry)
        self._robot = self._scene.add_frame("/robot", show_axes=False, position=geometry.spawn)
        self._ghost = self._scene.add_frame("/ghost", show_axes=False, visible=False)
        self._add_robot(model)
        self._setpoint = self._scene.add_icosphere(
            "/setpoint", 0.04, SETPOINT_COLOUR, opacity=0.8, visible=False, cast_shadow=False
        )
        self._waypoints: list[Any] = []  # spheres
        self._labels: list[Any] = []
        self._points: Array = np.zeros((0, 3))  # of the waypoints [m]
        server.initial_camera.position, server.initial_camera.look_at = _camera(geometry)

    def set_robot(self, position: Vector | Array, orientation_wxyz: Array) -> None:
        """Move the robot to the `position` of its base [m], shape (3,).

        `orientation_wxyz` is a unit quaternion, body to world, shape (4,).
        """
        self._robot.position, self._robot.wxyz = np.asarray(position), np.asarray(orientation_wxyz)

    def set_ghost(self, position: Vector | Array | None, orientation_wxyz: Array | None) -> None:
        """Move the predicted robot to a `position` [m], shape (3,); None hides it.

        `orientation_wxyz` is a unit quaternion, body to world, shape (4,).
        """
        shown = position is not None and orientation_wxyz is not None
        if shown:
            self._ghost.position = np.asarray(position)
            self._ghost.wxyz = np.asarray(orientation_wxyz)
        if self._ghost.visible != shown:
            self._ghost.visible = shown

    def set_trail(self, points: Array, clearances: Array) -> None:
        """Draw the flown path, coloured by clearance.

        Args:
            points: Positions of the base [m], shape (n, 3).
            clearances: Distance to the nearest wall at each point [m], shape (n,); NaN or an
                empty array if unknown.
        """
        if len(points) < 2:
            self._scene.remove_by_name("/trail")
            return
        colours = np.tile(np.array(GHOST_COLOUR, dtype=np.uint8), (len(points), 1))
        if len(clearances) == len(points):
            known = np.isfinite(clearances)
            colours[known] = clearance_colours(np.asarray(clearances)[known])
        self._scene.add_line_segments(
            "/trail",
            np.stack([points[:-1], points[1:]], axis=1).astype(np.float32),
            np.stack([colours[:-1], colours[1:]], axis=1),
            thickness=0.03,
        )

    def set_waypoints(self, points: Array, reached: int) -> None:
        """Show numbered waypoints at `points` [m], shape (n, 3), the first `reached` in green."""
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        if not np.array_equal(points, self._points):
            for handle in self._waypoints:  # with its label
                handle.remove()
            self._points = points
            self._waypoints = [
                self._scene.add_icosphere(
                    f"/waypoints/{number}", 0.06, OPEN_COLOUR, position=point, cast_shadow=False
                )
                for number, point in enumerate(points, start=1)
            ]
            self._labels = [
                self._scene.add_label(
                    f"/waypoints/{number}/label",
                    str(number),
                    position=(0.0, 0.0, 0.14),
                    anchor="bottom-center",
                )
                for number in range(1, len(points) + 1)
            ]
        for number, sphere in enumerate(self._waypoints):
            colour = REACHED_COLOUR if number < reached else OPEN_COLOUR
            if tuple(sphere.color) != colour:
                sphere.color = colour

    def set_setpoint(self, position: Vector | Array | None) -> None:
        """Show the `position` that the controller tracks [m], shape (3,); None hides it."""
        if position is not None:
            self._setpoint.position = np.asarray(position)
        if self._setpoint.visible != (position is not None):
            self._setpoint.visible = position is not None

    def _add_surroundings(self, model: Any, geometry: Scene) -> None:
        """Add all static shapes: planes as grids, pipes as smooth tubes, the rest as they are."""
        pipes = {pipe.name for pipe in geometry.pipes}
        bodies = defaultdict(list)
        for geom in map(int, np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0)):
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                self._scene.add_grid(
                    "/floor",
                    infinite_grid=True,
                    fade_distance=40.0,
                    cell_size=0.5,
                    cell_color=(228, 230, 233),
                    section_color=(206, 210, 214),
                    plane_color=(246, 247, 248),
                    plane_opacity=1.0,
                    shadow_opacity=0.25,
                    position=model.geom_pos[geom] - (0.0, 0.0, 0.002),
                )
            elif (name := model.geom(geom).name.rpartition("/")[0]) not in pipes:
                bodies[name].append(geom)
        for name, geoms in bodies.items():
            self._add_geoms(f"/{name}", model, geoms)
        for pipe in geometry.pipes:
            for part, opacity, (vertices, faces) in (
                ("bore", PIPE_OPACITY, _surface(pipe, (pipe.inner, -0.5), (pipe.inner, 0.5))),
                ("begin", None, _surface(pipe, (pipe.inner, -0.5), (pipe.outer, -0.5))),
                ("end", None, _surface(pipe, (pipe.inner, 0.5), (pipe.outer, 0.5))),
            ):
                self._scene.add_mesh_simple(
                    f"/{pipe.name}/{part}",
                    vertices,
                    faces,
                    color=PIPE_COLOUR,
                    opacity=opacity,
                    side="back" if part == "bore" else "double",
                    cast_shadow=False,
                )

    def _add_robot(self, model: Any) -> None:
        base = model.jnt_bodyid[0]
        geoms = list(map(int, np.flatnonzero(model.body_rootid[model.geom_bodyid] == base)))
        self._add_geoms("/robot", model, geoms)
        self._add_geoms("/ghost", model, geoms, GHOST_COLOUR)
        hubs = np.array([model.site(f"{ROBOT_PREFIX}{rotor}").pos for rotor in ROTORS])
        struts = np.stack([hubs * (0.0, 0.0, 1.0), hubs], axis=1)
        self._scene.add_line_segments(
            "/robot/struts", struts, ROD_COLOUR, thickness=STRUT_RADIUS * 2
        )

    def _add_geoms(
        self, parent: str, model: Any, geoms: list[int], colour: Colour | None = None
    ) -> None:
        """Add geoms of one body, one mesh for each colour; all in `colour` if it is given."""
        # It imports mujoco, which cloudrc.world.scene has imported without OpenGL.
        from mjviser.conversions import merge_geoms

        groups = defaultdict(list)
        for geom in geoms:
            paint = (*colour, GHOST_OPACITY) if colour else tuple(map(float, model.geom_rgba[geom]))
            groups[paint].append(geom)
        for number, ((*rgb, opacity), members) in enumerate(groups.items()):
            mesh = merge_geoms(model, members)
            self._scene.add_mesh_simple(
                f"{parent}/{number}",
                mesh.vertices,
                mesh.faces,
                color=colour or np.array(rgb),
                opacity=None if opacity == 1.0 else opacity,
                flat_shading=True,
                cast_shadow=colour is None,
            )


def clearance_colours(clearances: Array) -> NDArray[np.uint8]:
    """Return the RGB colours of clearances [m], shape (n,): uint8, shape (n, 3)."""
    place = np.linspace(0.0, CLEARANCE_SHOWN, len(VIRIDIS))
    parts = [np.interp(clearances, place, VIRIDIS[:, part]) for part in range(3)]
    return np.asarray(np.rint(np.stack(parts, axis=1)), dtype=np.uint8)


def _surface(
    pipe: Pipe, first: tuple[float, float], last: tuple[float, float], sides: int = 64
) -> tuple[Array, Array]:
    """Make a surface around a pipe's axis between two circles: a wall of the pipe or a rim.

    Each circle has a radius [m] and a place along the axis, from -0.5 (begin) to 0.5 (end).

    Returns:
        Vertices [m], world frame, shape (2 * sides, 3), and faces, shape (2 * sides, 3).
    """
    axis, angle = np.array(pipe.axis), np.linspace(0.0, 2 * np.pi, sides, endpoint=False)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    ring = np.cos(angle)[:, None] * across + np.sin(angle)[:, None] * np.cross(axis, across)
    circles = [
        np.array(pipe.centre) + place * pipe.length * axis + radius * ring
        for radius, place in (first, last)
    ]
    here, there = np.arange(sides), np.roll(np.arange(sides), -1)
    faces = [[here, there, here + sides], [there, there + sides, here + sides]]
    return np.concatenate(circles), np.concatenate([np.stack(each, axis=1) for each in faces])


def _camera(geometry: Scene) -> tuple[Vector, Vector]:
    """Choose where the viewer is and where the viewer looks [m], so that the scene is in sight."""
    spots = np.array([geometry.spawn, *(pipe.centre for pipe in geometry.pipes)])
    low, high = spots.min(axis=0), spots.max(axis=0)
    middle, size = (low + high) / 2, max(float(np.linalg.norm(high - low)), 2.5)
    x, y, z = middle + size * np.array([0.42, 0.62, 0.48])
    return (float(x), float(y), float(z)), (float(middle[0]), float(middle[1]), float(middle[2]))
