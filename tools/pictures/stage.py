# SPDX-License-Identifier: Apache-2.0

"""Render robots in a scene, without a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from tools.pictures import mujoco

Array: TypeAlias = NDArray[Any]
Colour: TypeAlias = tuple[float, float, float, float]

GHOST, GOAL = (0.34, 0.71, 0.91, 0.35), (0.95, 0.45, 0.05, 1.0)
"""Colours of the robot that cloud predicts, and of the setpoint: as in the console."""
BLUE, RED = (0.0, 0.45, 0.70, 1.0), (0.84, 0.20, 0.0, 1.0)
"""Colours of the path, and of what a robot touches and may not touch."""
LINE = 0.015
"""Radius of the line of the path [m]."""
LAMP = 8.0
"""Height of the lamp above the point at which the camera looks [m]."""
GLASS, FLOOR = (0.62, 0.72, 0.82, 0.75), (0.90, 0.91, 0.93)


@dataclass(frozen=True)
class View:
    """Where the camera stands: it looks at a point from a distance."""

    at: Sequence[float]  # [m], shape (3,)
    distance: float  # [m]
    azimuth: float  # of the direction in which it looks, from the x axis [deg]
    elevation: float = -30.0  # of this direction; negative: it looks down [deg]


class Stage:
    """A scene with copies of a robot, of which each has a pose."""

    def __init__(
        self, robot: str, scene: str, size: tuple[int, int], copies: Mapping[str, Colour | None]
    ) -> None:
        """Compile the scene.

        Args:
            robot: Name of a shipped robot.
            scene: Name of a shipped scene.
            size: Width and height of the pictures [pixels].
            copies: Name of each copy -> its colour; None: that of the robot.
        """
        spec = _furnished(scene)
        for name, colour in copies.items():
            _add_robot(spec, robot, name, colour)
        self.model = spec.compile()
        self.model.vis.global_.offwidth, self.model.vis.global_.offheight = width, height = size
        self.data = mujoco.MjData(self.model)
        self.renderer = mujoco.Renderer(self.model, height, width)

    def place(self, copy: str, position: Any, orientation_wxyz: Any = (1.0, 0.0, 0.0, 0.0)) -> None:
        """Move a copy to a position [m], shape (3,), and an orientation, a unit quaternion."""
        base = self.model.joint(f"{copy}/base")
        self.data.qpos[base.qposadr[0] :][:7] = np.concatenate([position, orientation_wxyz])

    def open_pipes(self, view: View) -> None:
        """Take away the half of each pipe that is between the camera and the robot."""
        mujoco.mj_forward(self.model, self.data)
        turn, rise = np.deg2rad((view.azimuth, view.elevation))
        looks = np.array((np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)))
        for number, body in enumerate(self.model.geom_bodyid):
            if self.model.body(body).name.startswith("pipe"):
                beyond = (self.data.geom_xpos[number] - self.data.xpos[body]) @ looks
                self.model.geom_rgba[number] = GLASS if beyond > -0.05 else (0.0,) * 4

    def draw(
        self,
        view: View,
        path: Array,
        colours: Sequence[Colour],
        balls: Sequence[tuple[Any, float, Colour]] = (),
    ) -> Array:
        """Return a picture, shape (height, width, 3).

        `path` [m], shape (n, 3), is a line with a colour per point. A ball has a centre [m], a
        radius [m] and a colour.
        """
        self.model.light("lamp").pos[:] = *view.at[:2], LAMP
        camera = mujoco.MjvCamera()
        camera.lookat[:], camera.distance = view.at, view.distance
        camera.azimuth, camera.elevation = view.azimuth, view.elevation
        mujoco.mj_forward(self.model, self.data)
        self.renderer.update_scene(self.data, camera)
        line, ball = mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_SPHERE
        for begin, end, colour in zip(path, path[1:], colours, strict=False):
            geom = self._add(line, LINE, colour)
            mujoco.mjv_connector(geom, line, LINE, begin, end)
        for centre, radius, colour in balls:
            self._add(ball, radius, colour, centre)
        return np.array(self.renderer.render())

    def _add(self, kind: Any, size: float, colour: Colour, centre: Any = (0.0, 0.0, 0.0)) -> Any:
        """Add a shape to the next picture, and return it."""
        scene = self.renderer.scene
        geom, turned = scene.geoms[scene.ngeom], np.eye(3).ravel()
        mujoco.mjv_initGeom(
            geom, kind, np.full(3, size), np.array(centre, float), turned, np.array(colour)
        )
        scene.ngeom += 1
        return geom


def check_size(target: Path, most: int) -> None:
    """Raise a ValueError if a file has more bytes than `most`."""
    size = target.stat().st_size
    if size > most:
        raise ValueError(f"{target}: {size:,} bytes, more than {most:,}: lower QUALITY")


def smooth(times: Array, positions: Array, now: float, spread: float) -> Array:
    """Return the mean position [m] around a time [s], with the weights of a normal distribution.

    `times` [s] have shape (n,), `positions` [m] (n, 3); `spread` is the standard deviation [s].
    """
    weights = np.exp(-0.5 * ((times - now) / spread) ** 2)
    return np.asarray(weights @ positions / weights.sum())


def _furnished(scene: str) -> Any:
    """Return a shipped scene with light, a bright floor and a sky."""
    spec = mujoco.MjSpec.from_file(str(file_of(scene)))
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=FLOOR,
        rgb2=FLOOR,
        markrgb=(0.76, 0.78, 0.80),
        width=256,
        height=256,
    )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(1.0, 1.0, 1.0),
        rgb2=FLOOR,
        width=64,
        height=64,
    )
    material = spec.add_material(name="floor", texrepeat=(1, 1), texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    for geom in spec.geoms:
        if geom.name == "floor":
            geom.material, geom.rgba = "floor", (1, 1, 1, 1)
    spec.worldbody.add_light(
        name="lamp",
        type=mujoco.mjtLightType.mjLIGHT_SPOT,
        dir=(0, 0, -1),
        cutoff=80,
        exponent=0,
        diffuse=(0.45,) * 3,
        castshadow=True,
    )
    spec.visual.headlight.ambient = (0.45,) * 3
    spec.visual.headlight.diffuse = (0.35,) * 3
    spec.visual.headlight.specular = (0.05,) * 3
    spec.visual.quality.shadowsize = 4096
    spec.visual.quality.offsamples = 4
    return spec


def _add_robot(spec: Any, robot: str, name: str, colour: Colour | None) -> None:
    """Add a copy of a robot at the spawn."""
    child = mujoco.MjSpec.from_file(str(find_robot(robot).model))
    if colour:
        for geom in child.geoms:
            geom.rgba = colour
    for site in child.sites:
        site.group = 4  # not drawn
    for option in (each for each in dir(spec.option) if not each.startswith("_")):
        setattr(child.option, option, getattr(spec.option, option))
    spec.attach(child, prefix=f"{name}/", frame="spawn")
