# SPDX-License-Identifier: Apache-2.0

"""Measure distances in the plane of a scanner with rays of MuJoCo.

The rays see the geoms of the scene, also those that nothing can touch, but not the robot.
"""

from __future__ import annotations

from copy import copy
from math import cos, sin
from typing import TYPE_CHECKING, Any

import numpy as np

from cloudrc.physics.geometry.rays import angles_of
from cloudrc.physics.sim.engine import mujoco
from cloudrc.physics.sim.scene import find_part, is_of_robot
from cloudrc.wire.messages import RangeScan

if TYPE_CHECKING:
    from cloudrc.config.robot import ScanConfig

SCENE_GROUP, ROBOT_GROUP = 0, 1
"""Groups of geoms in the scanner's own model: rays meet those of the first alone."""


class Scanner:
    """A scanner at a site of the robot: x of the site is ahead, the scan turns about its z.

    It has a model and an `MjData` of its own, so that a scan changes no bit of a flight.

    Attributes:
        config: Key `scan` of robot.yaml.
        angles: Of the rays [rad], rising to the left, shape (rays,).
    """

    def __init__(
        self, model: Any, data: Any, config: ScanConfig, noise: np.random.Generator
    ) -> None:
        """Find the scanner's site in a compiled `MjModel`; `noise` draws the errors.

        `data` is the flight's `MjData`.

        Raises:
            ValueError: If the robot has no such site.
        """
        self.config, self._noise = config, noise
        site = find_part(model, "site", config.site, "scan.site")
        self._model = copy(model)
        self._model.geom_group[:] = np.where(is_of_robot(model), ROBOT_GROUP, SCENE_GROUP)
        self._data = own = mujoco.MjData(self._model)
        # Views: each access to an array of MuJoCo makes a new one, which takes longer than its use.
        self._flown, self._qpos = data.qpos, own.qpos
        self._place, self._axes = own.site_xpos[site], own.site_xmat[site].reshape(3, 3)
        self._groups = np.arange(mujoco.mjNGROUP, dtype=np.uint8) == SCENE_GROUP
        self.angles = angles_of(config.rays, config.fov_deg)
        self._rays = np.array([(cos(each), sin(each), 0.0) for each in self.angles])
        self._turned = np.empty_like(self._rays)
        self._distances = np.empty(config.rays)
        self._geoms = np.empty(config.rays, np.int32)

    def measure(self, now_ns: int) -> RangeScan:
        """Scan from where the robot of the flight is; the stamp is `now_ns` [ns]."""
        config, distances = self.config, self._distances
        self._qpos[:] = self._flown
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mju_mulMatMatT(self._turned, self._rays, self._axes)
        mujoco.mj_multiRay(
            self._model, self._data, self._place, self._turned.ravel(), self._groups, True, -1,
            self._geoms, distances, None, config.rays, config.range_m,
        )  # fmt: skip
        found = self._noise.standard_normal(config.rays)  # as many for every scan
        found *= config.noise_m
        found += distances
        found *= 1e3
        np.rint(found, out=found)
        np.maximum(found, 1.0, out=found)
        found[(distances < 0.0) | (found > config.range_m * 1e3)] = 0.0
        return RangeScan(now_ns, tuple(found.astype(np.int32).tolist()))
