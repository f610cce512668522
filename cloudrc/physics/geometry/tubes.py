# SPDX-License-Identifier: Apache-2.0

"""Build the surfaces of a tube, a hollow cylinder of a scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cloudrc.physics.geometry.scene import Tube
from cloudrc.physics.geometry.shapes import Rgba, Surface, lathe


def wall(tube: Tube, rgba: Rgba, sides: int = 64) -> Surface:
    """Return the inner face of a tube, open at both ends."""
    half = tube.length / 2
    return _placed(tube, lathe([(tube.inner, -half), (tube.inner, half)], sides), rgba)


def rims(tube: Tube, rgba: Rgba) -> list[Surface]:
    """Return the two ring-shaped ends of a tube."""
    ends = -tube.length / 2, tube.length / 2
    return [_placed(tube, lathe([(tube.inner, z), (tube.outer, z)], 64), rgba) for z in ends]


def _placed(tube: Tube, surface: Surface, rgba: Rgba) -> Surface:
    axis = np.array(tube.axis)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    axes = np.stack([across, np.cross(axis, across), axis], axis=1)
    return replace(surface.placed(tube.centre, axes), body=tube.name, rgba=rgba)
