"""Project surfaces to the plane of a picture, and order their polygons from back to front."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection

from cloudrc.geometry.shapes import Array, Rgba, Surface, box

POLYGONS_MAX = 6000
"""Largest number of polygons of a picture that an SVG or PDF file keeps as such; more become a
bitmap, because a file of many megabytes is slow to show."""
CELL = 0.4
"""Longest edge of the polygons that a part of a scene is split into [m]: a polygon that is much
longer than its distance from another one cannot be ordered."""
GLASS, LARGE = 0.3, 0.2
"""Opacity of a body in front of the path, and share of its silhouette above which a face has an
outline."""
CLOSING = 0.15
"""Width of the edges of polygons [points]."""
DARKEST = 0.62
"""Brightness of a surface along the light; 1 is that of a surface at a right angle to it."""


class Polygons(NamedTuple):
    """Polygons with the same number of corners k; with k = 2 they are lines."""

    corners: Array  # [m], world frame, shape (m, k, 3)
    colours: Array  # red, green, blue, opacity in [0, 1], shape (m, 4)
    width: float = 1.2  # of lines [points]
    behind: float = 0.0  # by how much they count as farther away than they are [m]


class View:
    """A parallel projection of the world to a picture."""

    def __init__(self, right: Array, elevation: float) -> None:
        """Look with the unit vector `right`, level, shape (3,), as the picture's horizontal.

        `elevation` is the angle of the viewer above the horizontal plane [rad].
        """
        x, y, _ = right
        level = np.array([y, -x, 0.0])
        self.towards = np.cos(elevation) * level + np.sin(elevation) * np.array([0.0, 0.0, 1.0])
        """Unit vector from the scene to the viewer, world frame, shape (3,)."""
        self._sides = np.stack([right, np.cross(self.towards, right)], axis=1)

    def project(self, points: Array) -> Array:
        """Project points [m], world frame, shape (..., 3), to the picture [m], shape (..., 2)."""
        return np.asarray(points @ self._sides)

    def lift(self, flat: Array, depth: float) -> Array:
        """Return points `flat` [m] of the picture, shape (n, 2), in the world at `depth` [m]."""
        return np.asarray(flat @ self._sides.T + depth * self.towards)

    def polygons(self, surfaces: Iterable[Surface]) -> list[Polygons]:
        """Return the shaded polygons of surfaces; leave out those that a convex body hides."""
        light = (self.towards + self._sides[:, 1]) / np.sqrt(2)
        found = []
        for surface in surfaces:
            for corners in (surface.corners[faces] for faces in surface.faces):
                normals = _normals(corners)
                if surface.convex:
                    seen = normals @ self.towards > 1e-9
                    corners, normals = corners[seen], normals[seen]
                shade = DARKEST + (1.0 - DARKEST) * np.abs(normals @ light)
                colours = np.tile(surface.rgba, (len(corners), 1))
                colours[:, :3] *= shade[:, None]
                found.append(Polygons(corners, colours))
        return found

    def draw(self, axes: Axes, parts: Sequence[Polygons], zorder: float = 1.0) -> None:
        """Draw polygons and lines from back to front, in the layer `zorder` [1]."""
        if not (count := sum(len(part.corners) for part in parts)):
            return
        depth = np.concatenate(
            [(part.corners @ self.towards).mean(axis=1) - part.behind for part in parts]
        )
        flat = [corners for part in parts for corners in self.project(part.corners)]
        colours = np.concatenate([part.colours for part in parts])
        widths = np.concatenate([np.full(len(part.corners), _edge(part)) for part in parts])
        # The edges close the gaps between opaque neighbours, but would show between others.
        widths[(widths == CLOSING) & (colours[:, 3] < 1.0)] = 0.0
        order = np.argsort(depth, kind="stable")
        drawn = PolyCollection(
            [flat[n] for n in order],
            facecolors=colours[order],
            edgecolors=colours[order],
            linewidths=widths[order],
            rasterized=count > POLYGONS_MAX,
            zorder=zorder,
        )
        axes.add_collection(drawn)

    def hides(self, surface: Surface, points: Array) -> bool:
        """Return whether a surface hides one of `points` [m], world frame, shape (n, 3).

        A surface that is not of a convex body counts as the box around it.
        """
        body = surface if surface.convex else _box_around(surface)
        flat = [body.corners[faces] for faces in body.faces]
        normals = np.concatenate([_normals(corners) for corners in flat])
        offsets = np.einsum("ij,ij->i", normals, np.concatenate([each[:, 0] for each in flat]))
        # A point moves by t towards the viewer: it is inside of face i while n_i (p + t v) <= o_i.
        speed, room = normals @ self.towards, offsets - points @ normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            times = room / speed
        leaves = np.where(speed > 1e-9, times, np.inf).min(axis=1)
        enters = np.where(speed < -1e-9, times, -np.inf).max(axis=1)
        passes = (np.where(np.abs(speed) <= 1e-9, room, 0.0) >= 0.0).all(axis=1)
        return bool((passes & (leaves > np.maximum(enters, 0.0) + 1e-9)).any())


def glass(view: View, surface: Surface) -> list[Polygons]:
    """Return a surface as a translucent silhouette with the outlines of its large faces."""
    hull = outline(view.project(surface.corners))
    depth = float((surface.corners @ view.towards).mean())
    whole = view.lift(hull, depth)[None]
    r, g, b, opacity = surface.rgba
    found = [Polygons(whole, np.array([(r, g, b, opacity * GLASS)]))]
    dark = np.array([(*(DARKEST * part for part in (r, g, b)), 0.8)])
    edges = [whole]
    for corners in (surface.corners[faces] for faces in surface.faces):
        flat = view.project(corners)
        areas = np.abs(_areas(flat))
        seen = (_normals(corners) @ view.towards > 1e-9) & (areas > LARGE * abs(_areas(hull[None])))
        edges += [each[None] for each in corners[seen]]
    for polygon in edges:
        lines = np.stack([polygon[0], np.roll(polygon[0], -1, axis=0)], axis=1)
        found.append(Polygons(lines, np.repeat(dark, len(lines), axis=0), 0.4))
    return found


def _areas(polygons: Array) -> Array:
    """Return the areas of polygons in a plane [m^2], shape (m, k, 2); counter-clockwise: > 0."""
    x, y = np.moveaxis(polygons, 2, 0)
    areas: Array = (x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y).sum(axis=1) / 2
    return areas


def _edge(part: Polygons) -> float:
    """Return the width of the edges of polygons, or of lines [points]."""
    return part.width if part.corners.shape[1] == 2 else CLOSING


def outline(points: Array) -> Array:
    """Return the convex hull of `points` [m] in a plane, shape (n, 2), counter-clockwise."""
    ordered = np.unique(points, axis=0).tolist()
    if len(ordered) < 3:
        return np.array(ordered).reshape(-1, 2)
    halves = []
    for line in (ordered, ordered[::-1]):
        hull: list[list[float]] = []
        for point in line:
            while len(hull) > 1 and _turn(hull[-2], hull[-1], point) <= 0.0:
                hull.pop()
            hull.append(point)
        halves.append(hull[:-1])
    return np.array(halves[0] + halves[1])


def _turn(a: list[float], b: list[float], c: list[float]) -> float:
    """Return twice the area of a triangle, positive if counter-clockwise."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def split(surface: Surface) -> Surface:
    """Split the quadrangles and triangles of a surface until no edge is longer than `CELL`."""
    corners, indices, first = list[Array](), list[Any](), 0
    for faces in surface.faces:
        polygons = surface.corners[faces]
        if faces.shape[1] == 4:
            polygons = _split_quads(polygons)
        elif faces.shape[1] == 3:
            polygons = _split_triangles(polygons)
        count, k = polygons.shape[:2]
        corners.append(polygons.reshape(-1, 3))
        indices.append((np.arange(count * k, dtype=np.int32) + first).reshape(count, k))
        first += count * k
    return replace(surface, corners=np.concatenate(corners), faces=tuple(indices))


def _split_quads(quads: Array) -> Array:
    found = []
    for a, b, c, d in quads:
        across = max(np.linalg.norm(b - a), np.linalg.norm(c - d))
        along = max(np.linalg.norm(d - a), np.linalg.norm(c - b))
        columns, rows = (max(1, int(np.ceil(length / CELL))) for length in (across, along))
        x = np.linspace(0.0, 1.0, columns + 1)[None, :, None]
        y = np.linspace(0.0, 1.0, rows + 1)[:, None, None]
        grid = (1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * d + x * c)
        cells = np.stack([grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]], axis=2)
        found.append(cells.reshape(-1, 4, 3))
    return np.concatenate(found) if found else quads


def _split_triangles(triangles: Array, times: int = 6) -> Array:
    for _ in range(times):
        edges = np.linalg.norm(triangles - np.roll(triangles, -1, axis=1), axis=2).max(axis=1)
        if not (long := edges > CELL).any():
            break
        a, b, c = np.moveaxis(triangles[long], 1, 0)
        ab, bc, ca = (a + b) / 2, (b + c) / 2, (c + a) / 2
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        quarters = [np.stack(part, axis=1) for part in parts]
        triangles = np.concatenate([triangles[~long], *quarters])
    return triangles


def simplified(surface: Surface, cell: float) -> Surface:
    """Join the corners of a surface that lie in one cell of a grid; `cell` is its width [m].

    Details of a mesh that are smaller than a dot of the picture only make files larger.
    """
    places, rows = np.unique(np.round(surface.corners / cell), axis=0, return_inverse=True)
    if len(places) == len(surface.corners) or any(each.shape[1] != 3 for each in surface.faces):
        return surface
    triangles = rows.reshape(-1)[np.concatenate(surface.faces)]
    sides = triangles != np.roll(triangles, -1, axis=1)
    kept = np.unique(np.sort(triangles[sides.all(axis=1)], axis=1), axis=0)
    return replace(surface, corners=places * cell, faces=(kept.astype(np.int32),))


def lighter(rgba: Rgba, share: float) -> Rgba:
    """Mix a colour with white; `share` [1] is that of the white."""
    r, g, b, opacity = rgba
    return *(1.0 - (1.0 - each) * (1.0 - share) for each in (r, g, b)), opacity  # type: ignore[return-value]


def _normals(corners: Array) -> Array:
    """Return the unit normals of polygons [m], shape (m, k, 3); zero for a line."""
    if corners.shape[1] < 3:
        return np.zeros((len(corners), 3))
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 1])
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-12)[:, None])


def _box_around(surface: Surface) -> Surface:
    low, high = surface.corners.min(axis=0), surface.corners.max(axis=0)
    return box((high - low) / 2).placed((low + high) / 2, np.eye(3))
