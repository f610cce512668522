"""Build the surfaces of a tube, a hollow cylinder of a scene: whole, or cut open along its axis."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from cloudrc.geometry.scene import Tube
from cloudrc.geometry.shapes import Array, Rgba, Surface

STATION = 0.25
"""Length of the parts of a tube that is cut open [m]: a drawing sorts parts by distance."""


def wall(tube: Tube, rgba: Rgba, sides: int = 64) -> Surface:
    """Return the inner face of a tube, open at both ends."""
    first, last = (_arc(tube, tube.inner, end, _across(tube), np.pi, sides) for end in (-0.5, 0.5))
    return _between(tube.name, first, last, rgba)


def rims(tube: Tube, rgba: Rgba, sides: int = 64) -> list[Surface]:
    """Return the two ring-shaped ends of a tube."""
    found = []
    for end in (-0.5, 0.5):
        inner, outer = (
            _arc(tube, radius, end, _across(tube), np.pi, sides)
            for radius in (tube.inner, tube.outer)
        )
        found.append(_between(tube.name, inner, outer, rgba))
    return found


def cut_open(
    tube: Tube, towards: Array, inside: Rgba, cut: Rgba, station: float = STATION
) -> list[Surface]:
    """Return the half of a tube that is farther from a viewer in the direction `towards`.

    `towards` is a unit vector, world frame, shape (3,); `inside` and `cut` are the colours of the
    inner face and of the cut wall. The parts are about as long as `station` [m].
    """
    places = np.linspace(-0.5, 0.5, 1 + max(1, round(tube.length / station)))
    away = -(towards - (towards @ np.array(tube.axis)) * np.array(tube.axis))
    if (norm := float(np.linalg.norm(away))) < 1e-6:  # the viewer looks along the tube
        away, norm = _across(tube), 1.0
    inner, outer = (
        [_arc(tube, radius, place, away / norm, np.pi / 2, 16) for place in places]
        for radius in (tube.inner, tube.outer)
    )
    found = [_between(tube.name, *pair, inside) for pair in pairwise(inner)]
    for side in (0, -1):
        edge, rim = (np.array([arc[side] for arc in arcs]) for arcs in (inner, outer))
        found.append(_between(tube.name, edge, rim, cut))
    return found


def _across(tube: Tube) -> Array:
    """Return a unit vector at a right angle to the axis of a tube, shape (3,)."""
    axis = np.array(tube.axis)
    across = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    return np.asarray(across / np.linalg.norm(across))


def _arc(
    tube: Tube, radius: float, place: float, middle: Array, half_angle: float, sides: int
) -> Array:
    """Return points of a circle around the axis of a tube [m], world frame, shape (sides + 1, 3).

    `place` is the share of the tube's length from its centre, -0.5 to 0.5; `radius` is in [m]. The
    points are on an arc of twice the `half_angle` [rad], around the direction `middle`, shape (3,).
    """
    axis = np.array(tube.axis)
    angle = np.linspace(-half_angle, half_angle, sides + 1)[:, None]
    ring = np.cos(angle) * middle + np.sin(angle) * np.cross(axis, middle)
    return np.asarray(tube.centre + place * tube.length * axis + radius * ring)


def _between(body: str, first: Array, last: Array, rgba: Rgba) -> Surface:
    """Return the surface between two lines of n points [m], shape (n, 3)."""
    n = np.arange(len(first) - 1, dtype=np.int32)
    quads = np.stack([n, n + 1, n + 1 + len(first), n + len(first)], axis=1)
    return Surface(body, np.concatenate([first, last]), (quads,), rgba)
