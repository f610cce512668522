# SPDX-License-Identifier: Apache-2.0

"""Render what a camera of the robot sees, with MuJoCo and EGL: on a machine without a display, too.

Only a flight with a camera imports this module. The picture shows the scene, but not the robot.
Shadows and multisampling are off: they take most of the time where no GPU renders.
"""

from __future__ import annotations

import ctypes
import os
import weakref
from collections.abc import Callable
from copy import copy
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.physics.sim.egl import INSTALL, NO_EGL
from cloudrc.physics.sim.engine import mujoco, place_cameras
from cloudrc.physics.sim.scene import find_camera, is_of_robot

if TYPE_CHECKING:
    from cloudrc.config.camera import CameraConfig

# Mesa reads it as it is loaded. With one thread, its pixels and its processor time are repeatable.
os.environ.setdefault("LP_NUM_THREADS", "1")
HIDDEN = mujoco.mjNGROUP - 1
"""Group of the robot's geoms, which is not drawn; MuJoCo's viewers do not draw it, either."""
SPARE_GEOMS = 100
"""What is drawn besides the geoms of the model, such as the sky."""


def _open_egl() -> tuple[Any, Callable[[], None], str]:
    """Return an open context of EGL, what releases it from this thread, and what renders.

    Raises:
        MissingPrerequisiteError: If this machine cannot render.
    """
    try:
        from mujoco.egl import EGL, GLContext
        from OpenGL import GL

        context = GLContext(0, 0)
        context.make_current()
        return context, EGL.eglReleaseThread, GL.glGetString(GL.GL_RENDERER).decode()
    except (ImportError, AttributeError, RuntimeError, OSError, ctypes.ArgumentError) as error:
        text = NO_EGL.format(" ".join(str(error).split()))
        raise MissingPrerequisiteError(text, fix=INSTALL) from None


def _close(context: Any, drawing: Any) -> None:
    """Give the memory of a camera's buffers back."""
    context.make_current()
    drawing.free()
    context.free()


@cache
def find_renderer() -> str:
    """Return the name of what renders on this machine; raises as `Camera` does."""
    context, release, name = _open_egl()
    release()
    context.free()
    return name


class Camera:
    """A camera of the robot.

    It has a model and an `MjData` of its own, so that a picture changes no bit of a flight.

    Attributes:
        config: Key `camera` of robot.yaml.
        renderer: Name of what draws.
    """

    def __init__(self, model: Any, data: Any, config: CameraConfig) -> None:
        """Find the camera in a compiled `MjModel`; `data` is the flight's `MjData`.

        Raises:
            MissingPrerequisiteError: If this machine cannot render.
            ValueError: If the robot has no such camera.
        """
        self.config = config
        self._model = own = copy(model)
        own.geom_group[is_of_robot(model)] = HIDDEN
        own.light_castshadow[:] = 0
        own.vis.quality.shadowsize = own.vis.quality.offsamples = 0
        own.vis.global_.offwidth, own.vis.global_.offheight = config.width, config.height
        self._flown, self._data = data, mujoco.MjData(own)
        self._view, self._options = mujoco.MjvCamera(), mujoco.MjvOption()
        self._view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._view.fixedcamid = find_camera(model, config)
        self._options.sitegroup[:] = 0
        self._scene = mujoco.MjvScene(own, model.ngeom + SPARE_GEOMS)
        self._window = mujoco.MjrRect(0, 0, config.width, config.height)
        # A context is of one thread at a time, so each use takes and releases it.
        self._context, self._release, self.renderer = _open_egl()
        self._drawing = mujoco.MjrContext(own, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._drawing)
        self._release()
        # A sweep opens a camera for each flight. At the end of the process EGL is gone before.
        weakref.finalize(self, _close, self._context, self._drawing).atexit = False

    def aim(self) -> None:
        """Remember where everything in the flight is, for `render`."""
        self._data.qpos[:] = self._flown.qpos
        self._data.mocap_pos[:] = self._flown.mocap_pos
        self._data.mocap_quat[:] = self._flown.mocap_quat

    def render(self) -> NDArray[np.uint8]:
        """Return what the camera saw at the last `aim`: red, green, blue, row 0 is the highest."""
        model, data = self._model, self._data
        place_cameras(model, data)
        drawn = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(model, data, self._options, None, self._view, drawn, self._scene)
        self._context.make_current()
        mujoco.mjr_render(self._window, self._scene, self._drawing)
        image = np.empty((self.config.height, self.config.width, 3), np.uint8)
        mujoco.mjr_readPixels(image, None, self._window, self._drawing)
        self._release()
        return np.ascontiguousarray(image[::-1])
