# SPDX-License-Identifier: Apache-2.0

"""The fence of the shipped scenes."""

from cloudrc.physics.geometry.obstacles import fence_of
from cloudrc.physics.geometry.scene import load_scene

FENCE = fence_of(load_scene("pipes"))
