# SPDX-License-Identifier: Apache-2.0

"""Read the bodies of a scene, and the size of a robot, with MuJoCo."""

from __future__ import annotations

from dataclasses import replace
from itertools import count, product
from pathlib import Path
from typing import Any

import numpy as np

from cloudrc.base.outside.values import InvalidValueError
from cloudrc.physics.geometry.fence import SPACE, Fence
from cloudrc.physics.geometry.scene import FLOOR, WORLD, Scene
from cloudrc.physics.geometry.solids import Array, Shape, Solid
from cloudrc.physics.sim.engine import GEOM, at_rest, compile_alone, compiling, mujoco

_SHAPES: dict[Any, Shape] = {
    GEOM.mjGEOM_BOX: "box",
    GEOM.mjGEOM_SPHERE: "sphere",
    GEOM.mjGEOM_CAPSULE: "capsule",
    GEOM.mjGEOM_CYLINDER: "cylinder",
    GEOM.mjGEOM_PLANE: "plane",
    GEOM.mjGEOM_MESH: "hull",
}
"""Type of a geom -> shape of its solid; all other types become an outline."""
ROBOT_BITS = 1
"""Value of contype and conaffinity of the robot's geoms, as far as a scene is concerned: a flight
whose robot meets other geoms does not begin."""


def read_scene(path: Path) -> Any:
    """Read a scene as `MjSpec`, and name each geom BODY/NUMBER.

    A body without a name belongs to the body around it. In the worldbody, such bodies are numbered.

    Raises:
        InvalidValueError: If the scene lacks a part or has a joint.
        ValueError: If MuJoCo cannot read the file.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    spawn = spec.frame("spawn")
    if spawn is None or spawn.parent.name != WORLD or spawn.frame is not None:
        raise InvalidValueError(f"{path}: needs a frame named spawn directly in its worldbody")
    if spec.body(FLOOR) is None:
        raise InvalidValueError(
            f"{path}: needs a body named floor that has the ground; all other bodies are obstacles"
        )
    _name_geoms(spec.worldbody)
    for joint in spec.joints:
        raise InvalidValueError(
            f"{path}: body {joint.parent.name or 'without a name'} has a joint; nothing but the "
            "robot may move: delete the joint"
        )
    return spec


def _name_geoms(worldbody: Any) -> None:
    numbers, unnamed = count(), count(1)
    waiting = [(WORLD, worldbody)]
    for name, body in waiting:
        for geom in body.geoms:
            geom.name = f"{name}/{next(numbers)}"
        for child in body.bodies:
            other = (
                f"unnamed body {next(unnamed)}" if body is worldbody and not child.name else name
            )
            waiting.append((child.name or other, child))


def complete(scene: Scene) -> Scene:
    """Return a scene with all its bodies and its fence; of its file nothing is left to be read.

    Without a declared fence, the fence is the box around spawn and geoms: with `SPACE` around walls
    and ceiling, it ends below at the ground under the spawn.

    Raises:
        InvalidValueError: If the file cannot be flown in.
    """
    path = scene.path
    assert path is not None
    with compiling(path):
        spec = read_scene(path)
        spec.compiler.fusestatic = False
        spawn = spec.frame("spawn").pos.copy()
        model = spec.compile()
    data = at_rest(model)
    names = [model.geom(geom).name.rpartition("/")[0] for geom in range(model.ngeom)]
    touchable = ((model.geom_contype | model.geom_conaffinity) & ROBOT_BITS) > 0
    solids = tuple(
        _solid(model, data, geom, name)
        for geom, name in enumerate(names)
        if name != FLOOR and touchable[geom]
    )
    bodies, tangible = tuple(dict.fromkeys(names)), {FLOOR, *(solid.name for solid in solids)}
    return replace(
        scene,
        path=None,
        own_fence=scene.own_fence or _fence_around(model, data, spawn, touchable),
        solids=solids,
        bodies=bodies,
        intangible=tuple(name for name in bodies if name not in tangible),
    )


def _fence_around(model: Any, data: Any, spawn: Array, touchable: Any) -> Fence:
    """Return the fence around the point `spawn` [m] and the `touchable` geoms that have an end."""
    corners = [spawn]
    for geom in np.flatnonzero(touchable & (model.geom_type != GEOM.mjGEOM_PLANE)):
        axes, box = data.geom_xmat[geom].reshape(3, 3), model.geom_aabb[geom]
        centre, half = data.geom_xpos[geom] + axes @ box[:3], np.abs(axes) @ box[3:]
        corners += [centre - half, centre + half]
    (ax, ay, _), (bx, by, bz) = np.min(corners, axis=0).tolist(), np.max(corners, axis=0).tolist()
    down = np.array((0.0, 0.0, -1.0))
    distance = mujoco.mj_ray(model, data, spawn, down, None, 1, -1, np.zeros(1, np.int32))
    ground = float(spawn[2] - max(distance, 0.0))
    return Fence((ax - SPACE, ay - SPACE, ground), (bx + SPACE, by + SPACE, bz + SPACE))


def _solid(model: Any, data: Any, geom: int, name: str) -> Solid:
    shape = _SHAPES.get(GEOM(model.geom_type[geom]), "outline")
    centre, axes = data.geom_xpos[geom].copy(), data.geom_xmat[geom].reshape(3, 3).copy()
    size, faces = model.geom_size[geom].copy(), None
    if shape == "hull":
        faces = _faces(model, model.geom_dataid[geom])
    elif shape == "outline":
        centre, size = centre + axes @ model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:].copy()
    return Solid(name, shape, centre, axes, size, faces)


def _faces(model: Any, mesh: int) -> tuple[Array, Array, Array]:
    """Return the faces of a mesh's convex hull: normals (m, 3), offsets (m,) [m]; its edges.

    An edge is its two ends [m]: shape (k, 2, 3).
    """
    first, number = model.mesh_polyadr[mesh], model.mesh_polynum[mesh]
    starts = model.mesh_polyvertadr[first : first + number]
    numbers = model.mesh_polyvertnum[first : first + number]
    normals = model.mesh_polynormal[first : first + number].copy()
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :].astype(np.float64)
    pairs = set[tuple[int, ...]]()
    for start, corner_count in zip(starts.tolist(), numbers.tolist(), strict=True):
        corners = model.mesh_polyvert[start : start + corner_count].tolist()
        sides = zip(corners, corners[1:] + corners[:1], strict=True)
        pairs.update(tuple(sorted(side)) for side in sides)
    offsets = np.einsum("ij,ij->i", normals, vertices[model.mesh_polyvert[starts]])
    return normals, offsets, vertices[np.array(sorted(pairs))]


def reach_of(robot: Path) -> float:
    """Return the radius of the smallest ball about the base that holds a robot's geoms [m].

    Raise an InvalidValueError if the robot does not compile.
    """
    model = compile_alone(robot)
    if not model.njnt:  # no robot, as `sim.scene` says
        return 0.0
    data, body = at_rest(model), model.jnt_bodyid[0]
    geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body_rootid[body])
    base = data.xpos[body]
    return max((_reach(model, data, geom, base) for geom in geoms.tolist()), default=0.0)


def _reach(model: Any, data: Any, geom: int, base: Array) -> float:
    """Return the largest distance of a geom's points from the point `base` [m]."""
    kind, size = GEOM(model.geom_type[geom]), model.geom_size[geom]
    centre, axes = data.geom_xpos[geom] - base, data.geom_xmat[geom].reshape(3, 3)
    points, round_off = np.zeros((1, 3)), model.geom_rbound[geom]
    if kind == GEOM.mjGEOM_CYLINDER:
        along = axes[:, 2] @ centre
        across = np.linalg.norm(centre - along * axes[:, 2])
        return float(np.hypot(abs(along) + size[1], across + size[0]))
    if kind == GEOM.mjGEOM_CAPSULE:
        points, round_off = np.outer((-size[1], size[1]), (0.0, 0.0, 1.0)), size[0]
    elif kind == GEOM.mjGEOM_BOX:
        points, round_off = np.array([*product((-1, 1), repeat=3)]) * size, 0.0
    elif kind == GEOM.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, number = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points, round_off = model.mesh_vert[first : first + number], 0.0
    return float(np.linalg.norm(centre + points @ axes.T, axis=1).max() + round_off)
