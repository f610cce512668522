"""Read a user's scene with MuJoCo: check its parts, and list its bodies and their shapes."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import count
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from cloudrc.errors import (
    BadInputError,
    CloudrcError,
    MissingPrerequisiteError,
    OutOfMemoryError,
    tells_no_memory,
)
from cloudrc.geometry.fence import Corners
from cloudrc.geometry.model_files import model_files
from cloudrc.geometry.scene import FLOOR, WORLD
from cloudrc.geometry.solids import Array, Shape, Solid


def import_mujoco() -> Any:
    """Import MuJoCo without OpenGL, which a flight does not need.

    With MUJOCO_GL=egl and no libEGL, `import mujoco` fails. MUJOCO_GL is therefore `disable` during
    the import. Afterwards it has its old value, for a child process that renders.
    """
    wanted = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    except ImportError as error:
        raise MissingPrerequisiteError(
            f"the simulator needs MuJoCo ({error}); run: pip install 'cloudrc[world]'"
        ) from None
    finally:
        del os.environ["MUJOCO_GL"]
        if wanted is not None:
            os.environ["MUJOCO_GL"] = wanted
    return mujoco


mujoco = import_mujoco()
# Otherwise MuJoCo writes its warnings to MUJOCO_LOG.TXT in the working directory.
mujoco.set_mju_user_warning(logging.getLogger("mujoco").warning)

_GEOM = mujoco.mjtGeom
_SHAPES: dict[Any, Shape] = {
    _GEOM.mjGEOM_BOX: "box",
    _GEOM.mjGEOM_SPHERE: "sphere",
    _GEOM.mjGEOM_CAPSULE: "capsule",
    _GEOM.mjGEOM_CYLINDER: "cylinder",
    _GEOM.mjGEOM_ELLIPSOID: "ellipsoid",
    _GEOM.mjGEOM_PLANE: "plane",
    _GEOM.mjGEOM_MESH: "hull",
}
"""Type of a geom -> shape of its solid; all other types become an outline."""
ROBOT_BITS = 1
"""Value of contype and conaffinity of the robot's geoms, as far as a scene is concerned: a flight
whose robot meets other geoms is refused."""


class Bodies(NamedTuple):
    """The bodies of a scene."""

    names: tuple[str, ...]  # of all bodies with geoms; geoms in the worldbody belong to `world`
    solids: tuple[Solid, ...]  # everything that the robot can touch, except the floor
    extent: Corners  # of a box with the spawn, and with all that can be touched but planes
    ground: float  # height of what is below the spawn [m], world frame; else of the spawn
    inner: dict[str, tuple[str, ...]]  # body without geoms of its own -> bodies inside with geoms


def compile_error(what: str, error: Exception) -> CloudrcError:
    """Return the error to raise if MuJoCo cannot compile `what` because of `error`.

    MuJoCo reports a lack of memory as an error of the file. It says nothing about the file.
    """
    reason = " ".join(str(error).split())
    if tells_no_memory(reason):
        text = f"memory ran out: {what} could not be compiled"
        return OutOfMemoryError(f"{text}; use fewer processes, or free some memory")
    return BadInputError(f"{what} does not compile: {reason}")


def read_scene(path: Path) -> Any:
    """Read a scene as `MjSpec`, and name each geom BODY/NUMBER.

    A body without a name belongs to the body around it. In the worldbody, such bodies are numbered.

    Raises:
        BadInputError: If the scene lacks a part or has a joint.
        ValueError: If MuJoCo cannot read the file.
    """
    spec = mujoco.MjSpec.from_file(str(path))
    spawn = spec.frame("spawn")
    if spawn is None:
        raise BadInputError(f"{path}: needs a frame named spawn in its worldbody")
    if spawn.parent.name != WORLD or spawn.frame is not None:
        raise BadInputError(
            f"{path}: the frame spawn is inside of a body or another frame; put it directly into "
            "the worldbody"
        )
    if spec.body(FLOOR) is None:
        raise BadInputError(
            f"{path}: needs a body named floor that has the ground; all other bodies are obstacles"
        )
    _name_geoms(spec.worldbody)
    for joint in spec.joints:
        raise BadInputError(
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


def read_bodies(path: Path) -> Bodies:
    """Return the bodies of a scene; raise a BadInputError if its file cannot be flown in."""
    try:
        states = [(str(file), file.stat()) for file in model_files(path)]
    except OSError as error:
        raise BadInputError(f"{path}: cannot be read: {error.strerror}") from None
    version = [(file, state.st_mtime_ns, state.st_size) for file, state in states]
    return _read_bodies(path, *version)


@lru_cache(maxsize=16)
def _read_bodies(path: Path, *version: tuple[str, int, int]) -> Bodies:
    """Return the bodies of a scene; `version` differs between contents of its files."""
    try:
        spec = read_scene(path)
        spec.compiler.fusestatic = False
        spawn = spec.frame("spawn").pos.copy()
        model = spec.compile()
    except (ValueError, KeyError) as error:
        raise compile_error(str(path), error) from None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names = [model.geom(geom).name.rpartition("/")[0] for geom in range(model.ngeom)]
    touchable = (model.geom_contype | model.geom_conaffinity) & ROBOT_BITS
    solids = [
        _solid(model, data, geom, name)
        for geom, name in enumerate(names)
        if name != FLOOR and touchable[geom]
    ]
    extent, ground = _extent(model, data, spawn), _ground(model, data, spawn)
    return Bodies(tuple(dict.fromkeys(names)), tuple(solids), extent, ground, _inner(spec, names))


def _inner(spec: Any, names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Return, for each body without geoms of its own, the bodies with geoms inside of it."""
    found = {
        body.name: tuple(child.name for child in _inside(body) if child.name in names)
        for body in spec.bodies
        if body.name not in {"", WORLD, *names}
    }
    return {name: inside for name, inside in found.items() if inside}


def _inside(body: Any) -> Iterator[Any]:
    for child in body.bodies:
        yield child
        yield from _inside(child)


def _extent(model: Any, data: Any, spawn: Array) -> Corners:
    """Return the corners of the box with the point `spawn` [m] and all geoms that have an end."""
    corners = [spawn]
    touchable = (model.geom_contype | model.geom_conaffinity) & ROBOT_BITS
    for geom in np.flatnonzero(touchable & (model.geom_type != _GEOM.mjGEOM_PLANE)):
        axes, box = data.geom_xmat[geom].reshape(3, 3), model.geom_aabb[geom]
        centre, half = data.geom_xpos[geom] + axes @ box[:3], np.abs(axes) @ box[3:]
        corners += [centre - half, centre + half]
    (ax, ay, az), (bx, by, bz) = np.min(corners, axis=0).tolist(), np.max(corners, axis=0).tolist()
    return (ax, ay, az), (bx, by, bz)


def _ground(model: Any, data: Any, spawn: Array) -> float:
    """Return the height of the highest surface below the point `spawn` [m], else of the point."""
    down = np.array((0.0, 0.0, -1.0))
    distance = mujoco.mj_ray(model, data, spawn, down, None, 1, -1, np.zeros(1, np.int32))
    return float(spawn[2] - max(distance, 0.0))


def _solid(model: Any, data: Any, geom: int, name: str) -> Solid:
    shape = _SHAPES.get(_GEOM(model.geom_type[geom]), "outline")
    centre, axes = data.geom_xpos[geom].copy(), data.geom_xmat[geom].reshape(3, 3).copy()
    size, radius, faces = model.geom_size[geom].copy(), float(model.geom_rbound[geom]), None
    if shape == "plane":
        radius = inf
    elif shape == "hull":
        faces = _faces(model, model.geom_dataid[geom])
    elif shape == "outline":
        middle, size = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:].copy()
        centre, radius = centre + axes @ middle, float(np.linalg.norm(size))
    return Solid(name, shape, centre, axes, size, radius, faces)


def _faces(model: Any, mesh: int) -> tuple[Array, Array, Array]:
    """Return the faces of a mesh's convex hull: normals (m, 3), offsets (m,) [m]; its edges.

    An edge is its two ends [m]: shape (k, 2, 3).
    """
    first, number = model.mesh_polyadr[mesh], model.mesh_polynum[mesh]
    starts = model.mesh_polyvertadr[first : first + number]
    numbers = model.mesh_polyvertnum[first : first + number]
    normals = model.mesh_polynormal[first : first + number].copy()
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :].astype(np.float64)
    pairs = set[tuple[int, int]]()
    for start, corner_count in zip(starts.tolist(), numbers.tolist(), strict=True):
        corners = model.mesh_polyvert[start : start + corner_count].tolist()
        pairs.update(map(_ordered, corners, corners[1:] + corners[:1]))
    offsets = np.einsum("ij,ij->i", normals, vertices[model.mesh_polyvert[starts]])
    return normals, offsets, vertices[np.array(sorted(pairs))]


def _ordered(a: int, b: int) -> tuple[int, int]:
    return min(a, b), max(a, b)


def _compile_alone(robot: Path) -> tuple[Any, Any]:
    """Return the `MjModel` of a robot, and its `MjData` with the robot at rest.

    Raise a BadInputError if the robot does not compile.
    """
    try:
        model = mujoco.MjSpec.from_file(str(robot)).compile()
    except (ValueError, KeyError) as error:
        raise compile_error(str(robot), error) from None
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return model, data


def reach_of(robot: Path) -> float:
    """Return the radius of the smallest ball about the base that holds a robot's geoms [m].

    Raise a BadInputError if the robot does not compile.
    """
    model, data = _compile_alone(robot)
    if not model.njnt:  # no robot, as `world.scene` says
        return 0.0
    body = model.jnt_bodyid[0]
    geoms = np.flatnonzero(model.body_rootid[model.geom_bodyid] == model.body_rootid[body])
    base = data.xpos[body]
    return max((_reach(model, data, geom, base) for geom in geoms.tolist()), default=0.0)


def _reach(model: Any, data: Any, geom: int, base: Array) -> float:
    """Return the largest distance of a geom's points from the point `base` [m]."""
    kind, size = _GEOM(model.geom_type[geom]), model.geom_size[geom]
    centre, axes = data.geom_xpos[geom] - base, data.geom_xmat[geom].reshape(3, 3)
    if kind == _GEOM.mjGEOM_CYLINDER:
        along = axes[:, 2] @ centre
        across = np.linalg.norm(centre - along * axes[:, 2])
        return float(np.hypot(abs(along) + size[1], across + size[0]))
    if kind == _GEOM.mjGEOM_CAPSULE:
        ends = centre + np.outer((-size[1], size[1]), axes[:, 2])
        return float(np.linalg.norm(ends, axis=1).max() + size[0])
    if kind == _GEOM.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first, number = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points = centre + model.mesh_vert[first : first + number] @ axes.T
        return float(np.linalg.norm(points, axis=1).max())
    if kind == _GEOM.mjGEOM_BOX:
        points = centre + (np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3) * size) @ axes.T
        return float(np.linalg.norm(points, axis=1).max())
    return float(np.linalg.norm(centre) + model.geom_rbound[geom])
