"""Show the robot and its surroundings in a browser: `FlightScene`, on viser and mjviser.

Only this module imports mjviser, which converts the shapes of the MuJoCo model to meshes.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from cloudrc.config.load import ResolvedExperiment
from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.geometry.clearance import CLEARANCE_SHOWN, Array
from cloudrc.geometry.compiled import mujoco
from cloudrc.geometry.scene import Pipe, Scene, load_scene
from cloudrc.messages import Vector
from cloudrc.world.scene import compile_model

Colour = tuple[int, int, int]
GHOST, SETPOINT, REACHED = (0, 114, 178), (213, 94, 0), (0, 158, 115)
OPEN, PIPE, STRUT, PLAN = (120, 124, 130), (110, 130, 150), (77, 77, 82), (176, 180, 186)
"""Colours; those of ghost, setpoint and reached waypoints are colours of the figures."""
FLOOR: dict[str, Any] = {
    **{"cell_color": (228, 230, 233), "section_color": (206, 210, 214)},
    **{"plane_color": (246, 247, 248), "plane_opacity": 1.0, "fade_distance": 40.0},
}
"""Look of the floor, which is shown as a grid."""
GHOST_OPACITY, PIPE_OPACITY = 0.35, 0.5
VIEW, LOOK, NEAREST = np.radians(75.0), np.array([0.7, -0.2, -0.7]), 3.5
"""Viewer: vertical angle of view [rad], direction, least distance from the middle [m]."""
VIRIDIS = "440154 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725"
"""Colours of clearance in the figures, evenly spaced from 0 to `CLEARANCE_SHOWN`."""
LEGEND = (
    '<div style="margin: 0 1em 0.6em; font-size: 0.8em">Path, distance to the pipe: 0 <span style="'
    "display: inline-block; width: 5em; height: 0.7em; background: linear-gradient(to right, "
    f'{", ".join(f"#{each}" for each in VIRIDIS.split())})"></span> {CLEARANCE_SHOWN:g} m</div>'
)
"""Line of HTML that explains the colours of the flown path."""


class FlightScene:
    """Robot, pipes, board and floor of an experiment in the scene of a viser server.

    The world frame of the scene is that of the flight [m]; its z axis points up.
    """

    def __init__(
        self, server: viser.ViserServer, experiment: ResolvedExperiment, aspect: float = 1.5
    ) -> None:
        """Add the static shapes, and the robot at its spawn.

        The first view shows the whole mission in a window whose width is at least `aspect` [1]
        times its height.

        Raises:
            BadInputError: If robot or scene are missing or unsuitable.
        """
        self._scene, world = server.scene, experiment.world
        model = compile_model(find_robot(world.robot).model, file_of(world.scene))
        geometry = load_scene(world.scene)
        # Without a graphics card, shadows cost more than ten times the rest of a picture.
        self._scene.configure_default_lights(cast_shadow=False)
        self._add_surroundings(model, geometry)
        add = self._scene.add_frame
        self._bodies: dict[str, Any] = {
            "robot": add("/robot", show_axes=False, position=geometry.spawn),
            "ghost": add("/ghost", show_axes=False, visible=False),
            "setpoint": self._scene.add_icosphere(
                "/setpoint", 0.09, SETPOINT, opacity=0.6, visible=False
            ),
        }
        self._add_robot(model)
        self._waypoints: list[Any] = []  # spheres
        self._points: Array = np.zeros((0, 3))  # of the waypoints [m]
        self._plan: Array = np.zeros((0, 3))  # waypoints that the line of the plan joins [m]
        waypoints = [point.position_m for point in experiment.mission.waypoints]
        camera = server.initial_camera
        camera.position, camera.look_at = _camera(geometry, waypoints, aspect)

    def move(
        self, body: str, position: Vector | Array | None, orientation_wxyz: Array | None = None
    ) -> None:
        """Move "robot", "ghost" (the predicted robot) or "setpoint"; position None hides the body.

        Args:
            body: One of the three names.
            position: Position of the base [m], shape (3,).
            orientation_wxyz: Unit quaternion, body to world, shape (4,); None keeps the last one.
        """
        node = self._bodies[body]
        if position is not None:
            node.position = np.asarray(position)
        if orientation_wxyz is not None:
            node.wxyz = np.asarray(orientation_wxyz)
        node.visible = position is not None

    def set_trail(self, points: Array, clearances: Array) -> None:
        """Draw the flown path, coloured by clearance.

        Args:
            points: Positions of the base [m], shape (n, 3).
            clearances: Distance to the nearest pipe wall at each point [m], shape (n,); infinite
                without pipes.
        """
        if len(points) < 2:
            self._scene.remove_by_name("/trail")
            return
        near = np.isfinite(clearances)[:, None]
        colours = np.where(near, clearance_colours(clearances), np.array(GHOST, dtype=np.uint8))
        ends = [np.stack([each[:-1], each[1:]], axis=1) for each in (points, colours)]
        self._scene.add_line_segments("/trail", *ends, thickness=0.03)

    def set_waypoints(self, points: Array, reached: int) -> None:
        """Show numbered waypoints at `points` [m], shape (n, 3), the first `reached` in green.

        A thin line shows the plan, from the last reached waypoint on.
        """
        points = np.asarray(points, dtype=float).reshape(-1, 3)
        self._draw_plan(points[max(reached - 1, 0) :])
        if not np.array_equal(points, self._points):
            for sphere in self._waypoints:
                sphere.remove()
            self._points, self._waypoints = points, []
            for number, point in enumerate(points, start=1):
                name, above = f"/waypoints/{number}", (0.0, 0.0, 0.14)
                self._waypoints.append(self._scene.add_icosphere(name, 0.06, OPEN, position=point))
                self._scene.add_label(
                    f"{name}/label", str(number), position=above, anchor="bottom-center"
                )
        for number, sphere in enumerate(self._waypoints):
            sphere.color = REACHED if number < reached else OPEN

    def _draw_plan(self, points: Array) -> None:
        """Draw a line through the waypoints ahead [m], shape (n, 3)."""
        if np.array_equal(points, self._plan):
            return
        self._plan = points
        if len(points) < 2:
            self._scene.remove_by_name("/plan")
        else:
            lines = np.stack([points[:-1], points[1:]], axis=1)
            self._scene.add_line_segments("/plan", lines, PLAN, thickness=0.03)

    def _add_surroundings(self, model: Any, geometry: Scene) -> None:
        """Add all static shapes: planes as grids, pipes as smooth tubes, others as in the model."""
        pipes = {pipe.name for pipe in geometry.pipes}
        bodies = defaultdict(list)
        for geom in map(int, np.flatnonzero(model.body_weldid[model.geom_bodyid] == 0)):
            name = model.geom(geom).name.rpartition("/")[0]
            if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE:
                self._scene.add_grid(
                    f"/{name}", position=model.geom_pos[geom], infinite_grid=True, **FLOOR
                )
            elif name not in pipes:
                bodies[name].append(geom)
        for name, geoms in bodies.items():
            self._add_geoms(f"/{name}", model, geoms)
        for pipe in geometry.pipes:
            inner, outer = pipe.inner, pipe.outer
            # Only the far wall is drawn, so that the robot in the pipe is seen from every side.
            look: Any = {"color": PIPE}
            name, wall = f"/{pipe.name}/wall", _surface(pipe, (inner, -0.5), (inner, 0.5))
            self._scene.add_mesh_simple(name, *wall, side="back", opacity=PIPE_OPACITY, **look)
            for end in (-0.5, 0.5):
                name, rim = f"/{pipe.name}/rim_{end:+}", _surface(pipe, (inner, end), (outer, end))
                self._scene.add_mesh_simple(name, *rim, side="double", **look)

    def _add_robot(self, model: Any) -> None:
        """Add the robot, its ghost (the predicted robot), and struts that only the page shows."""
        base = model.jnt_bodyid[0]
        geoms = list(map(int, np.flatnonzero(model.body_rootid[model.geom_bodyid] == base)))
        self._add_geoms("/robot", model, geoms)
        self._add_geoms("/ghost", model, geoms, GHOST)
        sites = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_SITE, 0]
        hubs = model.site_pos[sites]
        struts = np.stack([hubs * (0.0, 0.0, 1.0), hubs], axis=1)
        self._scene.add_line_segments("/robot/struts", struts, STRUT, thickness=0.012)

    def _add_geoms(
        self, parent: str, model: Any, geoms: list[int], ghost: Colour | None = None
    ) -> None:
        """Add a mesh per colour for the geoms of a body; with `ghost`, one mesh in that colour."""
        # mjviser imports mujoco, which cloudrc.world.scene has imported without OpenGL.
        from mjviser.conversions import merge_geoms

        groups = defaultdict(list)
        for geom in geoms:
            groups[() if ghost else tuple(map(float, model.geom_rgba[geom]))].append(geom)
        for number, (rgba, members) in enumerate(groups.items()):
            name, mesh = f"{parent}/{number}", merge_geoms(model, members)
            opacity = rgba[3] if rgba else GHOST_OPACITY
            look: Any = {"opacity": None if opacity == 1.0 else opacity, "flat_shading": True}
            look["color"] = ghost or np.array(rgba[:3])
            self._scene.add_mesh_simple(name, mesh.vertices, mesh.faces, **look)


def clearance_colours(clearances: Array) -> NDArray[np.uint8]:
    """Return the RGB colours for clearances [m], shape (n,); the result has the shape (n, 3)."""
    colours = np.array([list(bytes.fromhex(colour)) for colour in VIRIDIS.split()])
    place = np.linspace(0.0, CLEARANCE_SHOWN, len(colours))
    parts = [np.interp(clearances, place, part) for part in colours.T]
    return np.asarray(np.rint(np.stack(parts, axis=1)), dtype=np.uint8)


def _surface(
    pipe: Pipe, first: tuple[float, float], last: tuple[float, float], sides: int = 64
) -> tuple[Array, Array]:
    """Make the mesh between two circles around the axis of a pipe: its wall or a rim.

    Each circle is a radius [m] and a place along the axis, as a share of the pipe's length: -0.5 is
    one end of the pipe, 0.5 the other.

    Returns:
        Vertices [m], world frame, shape (2 * sides, 3), and faces, shape (2 * sides, 3).
    """
    axis, angle = np.array(pipe.axis), np.linspace(0.0, 2 * np.pi, sides, endpoint=False)[:, None]
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    ring = np.cos(angle) * across + np.sin(angle) * np.cross(axis, across)
    circles = [pipe.centre + z * pipe.length * axis + r * ring for r, z in (first, last)]
    here, there = np.arange(sides), np.roll(np.arange(sides), -1)
    faces = [
        np.stack(each, 1)
        for each in ((here, there, here + sides), (there, there + sides, here + sides))
    ]
    return np.concatenate(circles), np.concatenate(faces)


def _camera(geometry: Scene, waypoints: Sequence[Vector], aspect: float) -> tuple[Array, Array]:
    """Return the place of the viewer, and the point at which the viewer looks [m], shape (3,).

    The viewer looks along +x: the key ↑ moves the robot away from the viewer, the key ← to the
    viewer's left. The place is the nearest one from which spawn, pipes and waypoints are in sight.
    """
    pipes = [(pipe.centre, 0.5 * pipe.length * np.array(pipe.axis)) for pipe in geometry.pipes]
    ends = [centre + sign * half for centre, half in pipes for sign in (-1, 1)]
    forward = LOOK / np.linalg.norm(LOOK)
    right = np.cross(forward, (0.0, 0.0, 1.0)) / np.hypot(*forward[:2])
    axes = np.array([right, np.cross(right, forward), forward])
    *across, depth = axes @ np.array([geometry.spawn, *ends, *waypoints]).T
    slope = 0.8 * np.tan(VIEW / 2) * np.array([[aspect], [1.0]])  # with a margin
    least, most = (across - slope * depth).max(axis=1), (across + slope * depth).min(axis=1)
    middle = (depth.min() + depth.max()) / 2
    back = min(((most - least) / (2 * slope[:, 0])).min(), middle - NEAREST)
    place = (least + most) / 2
    return np.array([*place, back]) @ axes, np.array([*place, middle]) @ axes
