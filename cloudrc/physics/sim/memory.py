# SPDX-License-Identifier: Apache-2.0

"""Give compiled code what it needs of MuJoCo: its library, addresses, and where contacts may be."""

from __future__ import annotations

import ctypes
from copy import copy
from functools import cache
from math import dist, inf
from pathlib import Path
from struct import Struct
from typing import Any

import numpy as np

from cloudrc.physics.sim.engine import GEOM, mujoco
from cloudrc.physics.sim.scene import is_of_robot

MARGIN = 1e-3
"""Distance added to every geom with its own margin and gap [m]; it covers rounding errors."""
HUGE = 1e4
"""Half the edge of the box that stands for the space below a plane [m]."""
PAGE = 4096
"""Smallest size of a page [bytes]: a program may read all bytes of a page, or none."""
SMALLEST = "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
"""Model with which the offset of `mjData` is searched."""
MARK = 0x6E636F6E
"""Number that no other part of `mjData` contains."""
UNUSED_WITHOUT_CONTACTS = sum(
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{part}"))
    for part in ("CONTACT", "CONSTRAINT", "SENSOR", "SPRING", "DAMPER")
)
"""Parts of MuJoCo that do nothing while the robot touches nothing: its usual sensor is a touch
sensor."""


def without_contacts(model: Any, sensors: set[int]) -> Any:
    """Return a copy of a compiled `MjModel` without what does nothing while nothing is touched.

    `sensors` are the addresses of the robot's own sensors.
    """
    free = copy(model)
    free.opt.disableflags |= UNUSED_WITHOUT_CONTACTS
    touch = model.sensor_adr[model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH]
    if sensors <= {*touch.tolist()}:
        free.body_geomnum[:] = 0  # only contacts and sensors need poses of geoms
    else:
        free.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
    return free


def boxes_around(model: Any, data: Any) -> tuple[Any, float]:
    """Return a box with rounded edges around each geom of the scene, and the robot's radius [m].

    Each row of the array is a box: centre (3,) [m], axes (9,), half sizes (3,) [m], radius of the
    edges [m]. The steps in C search for contacts only while a ball with the robot's radius around
    the base's origin touches a box. If the model has springs or similar forces, the radius is
    infinite, so that C never leaves out the search.
    """
    option, rows, radius, own = model.opt, [], 0.0, is_of_robot(model)
    other = option.density, option.viscosity, model.nflex, model.npair, model.neq, model.ntendon
    each = model.dof_frictionloss, model.dof_damping, model.jnt_stiffness, model.body_gravcomp
    if any(other) or any(values.any() for values in each):
        radius = inf
    for geom in range(model.ngeom):
        size, bound = model.geom_size[geom], model.geom_rbound[geom]
        place, axes = data.geom_xpos[geom], data.geom_xmat[geom]
        margin = model.geom_margin[geom] + model.geom_gap[geom]
        margin = MARGIN + max(margin, option.o_margin)
        if own[geom]:
            radius = max(radius, dist(place, data.qpos[:3]) + bound + margin)
        elif model.geom_type[geom] == GEOM.mjGEOM_BOX:
            rows.append([*place, *axes, *size, margin])
        elif model.geom_type[geom] == GEOM.mjGEOM_PLANE:
            normal = axes.reshape(3, 3)[:, 2]
            rows.append([*(place - HUGE * normal), *axes, HUGE, HUGE, HUGE, margin])
        else:
            rows.append([*place, *axes, 0.0, 0.0, 0.0, bound + margin])
    return np.array(rows, float), radius


@cache
def mujoco_library() -> ctypes.CDLL:
    """Return MuJoCo's own library, which the engine has loaded."""
    folder = Path(mujoco.__file__).parent
    files = [*folder.glob("libmujoco.so*"), *folder.glob("libmujoco*.dylib")]
    if len(files) != 1:
        raise OSError(f"{folder}: has {len(files)} files of MuJoCo's library, not 1")
    return ctypes.CDLL(str(files[0]))


@cache
def contacts_offset() -> int:
    """Return the offset of the number of contacts in MuJoCo's `mjData` [bytes].

    The offset depends on MuJoCo's version. The function writes MARK to `data.ncon` and searches the
    memory of `data` for it. The address of `qpos` ends the search; it is in `mjData`, too, so that
    the search never leaves the memory of `data`. It runs once only: in memory that an earlier
    `mjData` has used, an old address could end the search too early.
    """
    data = mujoco.MjData(mujoco.MjModel.from_xml_string(SMALLEST))
    mark, end = Struct("i").pack(MARK), Struct("P").pack(data.qpos.ctypes.data)
    place, block = data._address, b""
    data.ncon = MARK
    while mark not in block:
        if end in block:
            raise OSError("mjData does not contain the number of contacts")
        place += len(block)
        block = ctypes.string_at(place, PAGE - place % PAGE)
    data.ncon = 0
    offset: int = place + block.index(mark) - data._address
    return offset
