# SPDX-License-Identifier: Apache-2.0

"""Find what renders without a display: EGL, usually that of Mesa."""

from __future__ import annotations

import ctypes

from cloudrc.base.errors import MissingPrerequisiteError

LIBRARY = "libEGL.so.1"
NO_EGL = "this machine cannot render ({})"
INSTALL = "run: apt-get install libegl1 libgl1-mesa-dri libopengl0"


def load_egl() -> None:
    """Load the library; whether a driver is there shows only as it renders.

    Raises:
        MissingPrerequisiteError: If there is no EGL.
    """
    try:
        ctypes.CDLL(LIBRARY)
    except OSError as error:
        raise MissingPrerequisiteError(NO_EGL.format(error), fix=INSTALL) from None
