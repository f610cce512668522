# SPDX-License-Identifier: Apache-2.0

"""Read the shapes of a robot and its scene from the compiled model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from cloudrc.physics.geometry import shapes
from cloudrc.physics.geometry.scene import FLOOR
from cloudrc.physics.geometry.shapes import Pose, Rgba, Shapes, Surface
from cloudrc.physics.sim.engine import GEOM, at_rest, mujoco
from cloudrc.physics.sim.scene import bodies_of_geoms, find_camera, find_part

if TYPE_CHECKING:
    from cloudrc.config.camera import CameraConfig

SHOWN = 3
"""Number of the first group of geoms that MuJoCo's viewers do not show: usually, geoms of groups
below show a robot, and those of this group are its coarser shape for contacts."""
UNSET: Rgba = (0.5, 0.5, 0.5, 1.0)
"""Colour of a geom without a colour; then its material has the colour."""
WIDE = 20.0
"""Half the edge of a plane without a size [m]."""


def shapes_of(
    model: Any, *, planar: bool, scan_site: str | None = None, camera: CameraConfig | None = None
) -> Shapes:
    """Return the shapes of a compiled `MjModel` of a robot in a scene.

    Joints are at rest. Planes of the body `floor` are left out, because viewers draw the floor as a
    grid. `planar` tells whether the robot stays on the ground, `scan_site` names the site of its
    scanner, `camera` is the key of robot.yaml.
    """
    data, base = at_rest(model), model.jnt_bodyid[0]
    places, turns = data.geom_xpos, data.geom_xmat.reshape(-1, 3, 3)
    position, axes = data.xpos[base], data.xmat[base].reshape(3, 3)
    bodies = bodies_of_geoms(model)
    found: list[Surface] = []
    for geom in _shown(model, bodies):
        body = bodies[geom]
        surface = _surface(model, geom)
        is_ground = body == FLOOR and model.geom_type[geom] == GEOM.mjGEOM_PLANE
        if is_ground or surface is None:
            continue
        surface = replace(surface, body=body, rgba=_rgba(model, geom))
        surface = surface.placed(places[geom], turns[geom])
        found.append(surface if body else surface.placed(-position @ axes, axes.T))
    shapes = Shapes.of(found, planar)

    def in_base(place: Any, turn: Any) -> Pose:
        wxyz = np.empty(4)
        mujoco.mju_mat2Quat(wxyz, (axes.T @ turn.reshape(3, 3)).ravel())
        x, y, z = ((place - position) @ axes).tolist()
        a, b, c, d = wxyz.tolist()
        return (x, y, z), (a, b, c, d)

    if scan_site is not None:
        site = find_part(model, "site", scan_site, "scan.site")
        shapes = replace(shapes, scanner=in_base(data.site_xpos[site], data.site_xmat[site]))
    if camera is not None:
        eye = find_camera(model, camera)
        optical = data.cam_xmat[eye].reshape(3, 3) * (1.0, -1.0, -1.0)  # MuJoCo looks along -z
        shapes = replace(shapes, camera=in_base(data.cam_xpos[eye], optical))
    return shapes


def _shown(model: Any, bodies: list[str]) -> list[int]:
    """Return the geoms to draw; `bodies` has the name of each geom's body.

    A body of which a viewer of MuJoCo would show nothing is drawn whole.
    """
    visible = [geom for geom in range(model.ngeom) if _rgba(model, geom)[3] > 0.0]
    usual = [geom for geom in visible if model.geom_group[geom] < SHOWN]
    known = {bodies[geom] for geom in usual}
    return sorted(usual + [geom for geom in visible if bodies[geom] not in known])


def _rgba(model: Any, geom: int) -> Rgba:
    """Return the colour of a geom, or of its material; of a texture, the mean colour."""
    own, material = tuple(map(float, model.geom_rgba[geom])), model.geom_matid[geom]
    if material < 0 or own != UNSET:
        return own  # type: ignore[return-value]
    r, g, b, opacity = map(float, model.mat_rgba[material])
    for texture in model.mat_texid[material]:
        if texture >= 0 and (channels := model.tex_nchannel[texture]) >= 3:
            first = model.tex_adr[texture]
            last = first + model.tex_width[texture] * model.tex_height[texture] * channels
            mean = model.tex_data[first:last].reshape(-1, channels)[:, :3].mean(axis=0) / 255
            return r * float(mean[0]), g * float(mean[1]), b * float(mean[2]), opacity
    return r, g, b, opacity


def _surface(model: Any, geom: int) -> Surface | None:
    """Return the surface of a geom in its own frame; None for a type without one."""
    kind, number = GEOM(model.geom_type[geom]), model.geom_dataid[geom]
    if kind in _SURFACES:
        return _SURFACES[kind](model.geom_size[geom].tolist())
    if kind == GEOM.mjGEOM_HFIELD:
        return _terrain(model, number)
    return _mesh(model, number) if number >= 0 else None  # also of a signed distance field


_SURFACES: dict[Any, Callable[[list[float]], Surface]] = {
    GEOM.mjGEOM_BOX: shapes.box,
    GEOM.mjGEOM_CYLINDER: lambda size: shapes.cylinder(*size[:2]),
    GEOM.mjGEOM_CAPSULE: lambda size: shapes.globe(size[:1] * 3, size[1]),
    GEOM.mjGEOM_SPHERE: lambda size: shapes.globe(size[:1] * 3),
    GEOM.mjGEOM_ELLIPSOID: shapes.globe,
    GEOM.mjGEOM_PLANE: lambda size: shapes.sheet(*(each or WIDE for each in size[:2])),
}


def _mesh(model: Any, number: int) -> Surface:
    first, count = model.mesh_vertadr[number], model.mesh_vertnum[number]
    corners = model.mesh_vert[first : first + count].astype(float)
    first, count = model.mesh_faceadr[number], model.mesh_facenum[number]
    return Surface("", corners, model.mesh_face[first : first + count].astype(np.int32))


def _terrain(model: Any, number: int) -> Surface:
    rows, columns = model.hfield_nrow[number], model.hfield_ncol[number]
    first = model.hfield_adr[number]
    half_x, half_y, height, base = model.hfield_size[number].tolist()
    heights = height * model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    return shapes.terrain(heights.astype(float), half_x, half_y, base)
