# SPDX-License-Identifier: Apache-2.0

"""Draw the pictures of the documentation with MuJoCo: `make pictures`.

They need EGL, for example that of Mesa, and neither a display nor a GPU.
"""

import os

os.environ.setdefault("MUJOCO_GL", "egl")

import mujoco  # before cloudrc does it, because cloudrc switches OpenGL off

__all__ = ["mujoco"]
