# SPDX-License-Identifier: Apache-2.0

"""Draw a robot alone, from the shapes of its compiled model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from cloudrc.physics.geometry.shapes import Surface
from cloudrc.results.report.figures import own_settings, save
from cloudrc.results.report.figures.style import Look

EDGE = 4.0
"""Width and height of the picture [in]."""


def draw_robot(surfaces: Sequence[Surface], kind: str = "png") -> bytes:
    """Return a picture of a robot's surfaces as a "png", "svg" or "pdf" file."""
    with own_settings(Look()):
        figure = Figure(figsize=(EDGE, EDGE), dpi=150)
        axes: Any = figure.add_axes((0.1, 0.05, 0.82, 0.9), projection="3d")
        for surface in surfaces:
            x, y, z = surface.corners.T
            axes.plot_trisurf(x, y, z, triangles=surface.triangles, color=surface.rgba)
        points = np.concatenate([surface.corners for surface in surfaces])
        middle, half = (points.max(0) + points.min(0)) / 2, np.ptp(points, axis=0).max() / 2
        for name, value in zip("xyz", middle, strict=True):
            getattr(axes, f"set_{name}lim")(value - half, value + half)
            getattr(axes, f"set_{name}label")(f"{name} [m]")
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=25, azim=-125)
        return save(figure, kind)
