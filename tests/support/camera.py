# SPDX-License-Identifier: Apache-2.0

"""Whether this machine renders; if it does not, tests with a camera are skipped."""

from ctypes.util import find_library

import pytest

needs_renderer = pytest.mark.skipif(
    find_library("EGL") is None,
    reason="no libEGL: apt-get install libegl1 libgl1-mesa-dri libopengl0",
)
