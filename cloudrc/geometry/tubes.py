"""Build the surfaces of a tube, a hollow cylinder of a scene."""

from __future__ import annotations

import numpy as np

from cloudrc.geometry.scene import Tube
from cloudrc.geometry.shapes import Array, Rgba, Surface


def wall(tube: Tube, rgba: Rgba, sides: int = 64) -> Surface:
    """Return the inner face of a tube, open at both ends."""
    first, last = (_ring(tube, tube.inner, end, sides) for end in (-0.5, 0.5))
    return _between(tube.name, first, last, rgba)


def rims(tube: Tube, rgba: Rgba, sides: int = 64) -> list[Surface]:
    """Return the two ring-shaped ends of a tube."""
    found = []
    for end in (-0.5, 0.5):
        inner, outer = (_ring(tube, radius, end, sides) for radius in (tube.inner, tube.outer))
        found.append(_between(tube.name, inner, outer, rgba))
    return found


def _ring(tube: Tube, radius: float, place: float, sides: int) -> Array:
    """Return points of a circle around the axis of a tube [m], world frame, shape (sides + 1, 3).

    `place` is the share of the tube's length from its centre, -0.5 to 0.5; `radius` is in [m].
    """
    axis = np.array(tube.axis)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    across /= np.linalg.norm(across)
    angle = np.linspace(-np.pi, np.pi, sides + 1)[:, None]
    ring = np.cos(angle) * across + np.sin(angle) * np.cross(axis, across)
    return np.asarray(tube.centre + place * tube.length * axis + radius * ring)


def _between(body: str, first: Array, last: Array, rgba: Rgba) -> Surface:
    """Return the surface between two lines of n points [m], shape (n, 3)."""
    n = np.arange(len(first) - 1, dtype=np.int32)
    quads = np.stack([n, n + 1, n + 1 + len(first), n + len(first)], axis=1)
    return Surface(body, np.concatenate([first, last]), (quads,), rgba)
