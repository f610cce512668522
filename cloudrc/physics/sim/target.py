# SPDX-License-Identifier: Apache-2.0

"""Move a body of the scene, and tell where it is in the picture of the robot's camera."""

from __future__ import annotations

from math import atan2, hypot, radians, tan
from typing import TYPE_CHECKING, Any

from cloudrc.physics.geometry.moving import Moving
from cloudrc.physics.sim.engine import at_rest, place_cameras
from cloudrc.physics.sim.scene import find_camera
from cloudrc.wire.records import TargetSeen

if TYPE_CHECKING:
    from cloudrc.config.camera import CameraConfig


class MovingTarget:
    """A body of the scene that moves, as a function of the time since the mission's start.

    The robot's camera is found on an `MjData` of its own, so that no bit of the flight changes.
    """

    def __init__(self, model: Any, data: Any, moving: Moving, camera: CameraConfig) -> None:
        """Find the body and the camera in a compiled `MjModel`; `data` is the flight's `MjData`.

        Raises:
            ValueError: If the robot has no such camera.
        """
        self._moving, self._begin_ns = moving, 0
        self._place = data.mocap_pos[model.body(moving.name).mocapid[0]]
        self._model, self._data = model, at_rest(model)
        self._flown, self._qpos = data.qpos, self._data.qpos
        number = find_camera(model, camera)
        self._eye = self._data.cam_xpos[number]
        self._axes = self._data.cam_xmat[number].reshape(3, 3)
        self._up = tan(radians(camera.fovy_deg) / 2.0)
        self._side = self._up * camera.width / camera.height

    def begin(self, now_ns: int) -> None:
        """Begin the path anew: a mission has started at `now_ns` [ns], world's clock."""
        self._begin_ns = now_ns

    def move(self, now_ns: int) -> None:
        """Move the body to its place at `now_ns` [ns], world's clock."""
        self._place[:] = self._moving.at((now_ns - self._begin_ns) * 1e-9)

    def observe(self, now_ns: int) -> TargetSeen:
        """Move the body, and return where it is at `now_ns` [ns], world's clock."""
        self.move(now_ns)
        self._qpos[:] = self._flown
        place_cameras(self._model, self._data)
        # A camera of MuJoCo looks along -z; x is to the right, y up.
        x, y, z = ((self._place - self._eye) @ self._axes).tolist()
        inside = -z > 0.0 and abs(x) <= -z * self._side and abs(y) <= -z * self._up
        px, py, pz = self._place.tolist()
        distance = hypot(x, y, z)
        return TargetSeen(now_ns, (px, py, pz), atan2(-x, -z), distance, inside)
