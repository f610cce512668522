# SPDX-License-Identifier: Apache-2.0

"""Show the robot and its surroundings in a browser: `FlightScene`, on viser."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.physics.geometry.clearance import CLEARANCE_SHOWN, Array
from cloudrc.physics.geometry.scene import FLOOR, Scene
from cloudrc.physics.geometry.shapes import Rgba, Shapes, Surface, merged
from cloudrc.physics.geometry.tubes import rims, wall
from cloudrc.wire.messages import Vector

Colour = tuple[int, int, int]
GHOST, SETPOINT, REACHED = (0, 114, 178), (213, 94, 0), (0, 158, 115)
OPEN, PLAN = (120, 124, 130), (176, 180, 186)
"""Colours; those of ghost, setpoint and reached waypoints are colours of the figures."""
GRID: dict[str, Any] = {
    "cell_color": (228, 230, 233),
    "section_color": (206, 210, 214),
    "plane_color": (246, 247, 248),
    "plane_opacity": 1.0,
    "fade_distance": 40.0,
}
"""Look of the floor, which is shown as a grid."""
USUAL = 0.85
"""Size of a robot that the balls in the scene fit [m]."""
GLASS: Rgba = (0.0, 0.447, 0.698, 0.35)
"""Colour and opacity of the predicted robot, in [0, 1]: that of GHOST."""
TUBE, RIM = (0.43, 0.51, 0.59, 0.5), (0.43, 0.51, 0.59, 1.0)
"""Colours of a tube's inner face and ends: red, green, blue, opacity in [0, 1]."""
GOAL_RADIUS, POINT_RADIUS = 0.09, 0.06
"""Largest radius of the setpoint and of a waypoint [m]; a small robot has smaller ones."""
SMALL = 0.025
"""Share of the distance to the viewer below which a robot's size gets a label."""
VIEW, LOOK, NEAREST = np.radians(75.0), np.array([0.7, -0.2, -0.7]), 3.5
"""Viewer: vertical angle of view [rad], direction, least distance from the middle [m]."""
VIRIDIS = "440154 472d7b 3b528b 2c728e 21918c 28ae80 5ec962 addc30 fde725"
"""Colours of clearance in the figures, evenly spaced from 0 to `CLEARANCE_SHOWN`."""
LEGEND = (
    '<div style="margin: 0 1em 0.6em; font-size: 0.8em">Path, clearance: 0 <span style="'
    "display: inline-block; width: 5em; height: 0.7em; background: linear-gradient(to right, "
    f'{", ".join(f"#{each}" for each in VIRIDIS.split())})"></span> {CLEARANCE_SHOWN:g} m</div>'
)
"""Line of HTML that explains the colours of the flown path."""


class FlightScene:
    """Robot, obstacles and floor of an experiment in the scene of a viser server.

    The world frame of the scene is that of the flight [m]; its z axis points up.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        experiment: ResolvedExperiment,
        shapes: Shapes,
        geometry: Scene,
        aspect: float = 1.5,
    ) -> None:
        """Add the static shapes, and the robot at its spawn.

        The first view shows the whole mission in a window whose width is at least `aspect` [1]
        times its height.

        `shapes` are those of robot and scene, `geometry` has the numbers of the scene.
        """
        self._scene = server.scene
        # Without a graphics card, shadows cost more than ten times the rest of a picture.
        self._scene.configure_default_lights(cast_shadow=False)
        scale = min(shapes.size / USUAL, 1.0) if shapes.robot else 1.0
        self._point_radius = POINT_RADIUS * scale
        add = self._scene.add_frame
        self._bodies: dict[str, Any] = {
            "robot": add("/robot", show_axes=False, position=geometry.spawn),
            "ghost": add("/ghost", show_axes=False, visible=False),
            "setpoint": self._scene.add_icosphere(
                "/setpoint", GOAL_RADIUS * scale, SETPOINT, opacity=0.6, visible=False
            ),
        }
        for each in geometry.moving:
            self._bodies[each.name] = add(f"/{each.name}", show_axes=False, visible=False)
        self._add_surroundings(shapes, geometry)
        self._add_meshes("/robot", shapes.robot)
        self._add_meshes("/ghost", shapes.robot, GLASS)
        self._waypoints: list[Any] = []  # spheres
        self._points: Array = np.zeros((0, 3))  # of the waypoints [m]
        self._plan: Array = np.zeros((0, 3))  # waypoints that the line of the plan joins [m]
        waypoints = [point.position_m for point in experiment.mission.waypoints]
        camera = server.initial_camera
        camera.position, camera.look_at = _camera(geometry, waypoints, aspect)
        distance = float(np.linalg.norm(camera.position - camera.look_at))
        if 0.0 < shapes.size < SMALL * distance:
            text = f"robot, {shapes.size * 100:.0f} cm"
            self._scene.add_label("/robot/size", text, anchor="bottom-center")

    def move(
        self, body: str, position: Vector | Array | None, orientation_wxyz: Array | None = None
    ) -> None:
        """Move "robot", "ghost" (the predicted robot), "setpoint" or a moving body of the scene.

        Args:
            body: Its name.
            position: Position of the base [m], shape (3,); None hides the body.
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
            clearances: Distance to the nearest obstacle at each point [m], shape (n,); infinite
                without obstacles.
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
                self._waypoints.append(
                    self._scene.add_icosphere(name, self._point_radius, OPEN, position=point)
                )
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

    def _add_surroundings(self, shapes: Shapes, geometry: Scene) -> None:
        """Add all static shapes: the floor as a grid, tubes smooth, others as in the model."""
        self._scene.add_grid(
            f"/{FLOOR}", position=(0.0, 0.0, geometry.floor), infinite_grid=True, **GRID
        )
        tubes = {tube.name for tube in geometry.tubes}
        bodies = defaultdict(list)
        for surface in shapes.scene:
            if surface.body not in tubes:
                bodies[surface.body].append(surface)
        for each in geometry.moving:
            back = np.negative(each.path[0])
            bodies[each.name] = [part.placed(back, np.eye(3)) for part in bodies[each.name]]
        for name, surfaces in bodies.items():
            self._add_meshes(f"/{name}", surfaces)
        for tube in geometry.tubes:
            # Only the far wall is drawn, so that the robot in the tube is seen from every side.
            self._add_mesh(f"/{tube.name}/wall", [wall(tube, TUBE)], TUBE, side="back")
            for end, rim in zip("+-", rims(tube, RIM), strict=True):
                self._add_mesh(f"/{tube.name}/rim_{end}", [rim], RIM, side="double")

    def _add_meshes(
        self, parent: str, surfaces: Sequence[Surface], ghost: Rgba | None = None
    ) -> None:
        """Add a mesh for each colour of a body; with `ghost`, one mesh in that colour."""
        groups: defaultdict[Rgba, list[Surface]] = defaultdict(list)
        for surface in surfaces:
            groups[ghost or surface.rgba].append(surface)
        for number, (rgba, members) in enumerate(groups.items()):
            is_closed = all(surface.convex for surface in members)
            self._add_mesh(f"{parent}/{number}", members, rgba, "front" if is_closed else "double")

    def _add_mesh(self, name: str, surfaces: Sequence[Surface], rgba: Rgba, side: Any) -> None:
        opacity = None if rgba[3] >= 1.0 else rgba[3]
        self._scene.add_mesh_simple(
            name,
            *merged(surfaces),
            color=np.array(rgba[:3]),
            opacity=opacity,
            side=side,
            flat_shading=True,
        )


def clearance_colours(clearances: Array) -> NDArray[np.uint8]:
    """Return the RGB colours for clearances [m], shape (n,); the result has the shape (n, 3)."""
    colours = np.array([list(bytes.fromhex(colour)) for colour in VIRIDIS.split()])
    place = np.linspace(0.0, CLEARANCE_SHOWN, len(colours))
    parts = [np.interp(clearances, place, part) for part in colours.T]
    return np.asarray(np.rint(np.stack(parts, axis=1)), dtype=np.uint8)


def _camera(geometry: Scene, waypoints: Sequence[Vector], aspect: float) -> tuple[Array, Array]:
    """Return the place of the viewer, and the point at which the viewer looks [m], shape (3,).

    The viewer looks along +x: the key ↑ moves the robot away from the viewer, the key ← to the
    viewer's left. A ball around spawn, tubes and waypoints is in sight.
    """
    tubes = [(tube.centre, 0.5 * tube.length * np.array(tube.axis)) for tube in geometry.tubes]
    ends = [centre + sign * half for centre, half in tubes for sign in (-1, 1)]
    points = np.array([geometry.spawn, *ends, *waypoints])
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = np.linalg.norm(points - middle, axis=1).max()
    slope = np.tan(VIEW / 2) * min(aspect, 1.0)
    away = max(NEAREST, radius / np.sin(np.arctan(slope)))
    return middle - away * LOOK / np.linalg.norm(LOOK), middle
