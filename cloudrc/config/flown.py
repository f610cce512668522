"""What a recording keeps of robot and scene, so that its report needs none of the user's files."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from pydantic import TypeAdapter

from cloudrc.errors import BadInputError
from cloudrc.geometry.clearance import Hull, Spheres
from cloudrc.geometry.fence import Fence
from cloudrc.geometry.obstacles import fence_of, without_file
from cloudrc.geometry.scene import Plate, Scene, Tube
from cloudrc.geometry.solids import SHAPES, Solid
from cloudrc.messages import Vector

FLOWN_FILE = "geometry.json"
"""Name of the attachment of a recording."""
_UNREADABLE = ValueError, TypeError, KeyError, AttributeError, RecursionError


@dataclass(frozen=True)
class FlownWorld:
    """Robot and scene of a flight, as numbers."""

    scene: Scene
    hull: Hull | None  # of the robot; None: not known
    planar: bool  # whether the robot stays on the ground

    @property
    def steered(self) -> Fence:
        """Fence inside which an operator steers; for a planar robot, at its height only."""
        fence = fence_of(self.scene)
        return replace(fence, ground=self.scene.spawn[2]) if self.planar else fence

    def to_bytes(self) -> bytes:
        """Return the content of a file, which `from_bytes` reads: every number is kept exactly."""
        scene = asdict(without_file(self.scene))
        hull = None if self.hull is None else self.hull.few._asdict()
        tree = {"scene": scene, "hull": hull, "planar": self.planar}
        return json.dumps(tree, default=lambda array: array.tolist()).encode()

    @staticmethod
    def from_bytes(data: bytes) -> FlownWorld:
        """Read the content of a file; raise a BadInputError if it is not readable."""
        try:
            tree = json.loads(data)
            hull = None
            if tree["hull"] is not None:
                positions, radii = tree["hull"]["positions"], tree["hull"]["radii"]
                spheres = Spheres(_array(positions, -1, 3), _array(radii, len(positions)))
                hull = Hull(spheres, spheres)
            return FlownWorld(_scene(tree["scene"]), hull, bool(tree["planar"]))
        except _UNREADABLE as error:
            raise BadInputError(f"{FLOWN_FILE} is not readable") from error


def _scene(tree: dict[str, Any]) -> Scene:
    return Scene(
        name=str(tree["name"]),
        tubes=TypeAdapter(tuple[Tube, ...]).validate_python(tree["tubes"]),
        plates=TypeAdapter(tuple[Plate, ...]).validate_python(tree["plates"]),
        floor=float(tree["floor"]),
        spawn=TypeAdapter(Vector).validate_python(tree["spawn"]),
        own_fence=TypeAdapter(Fence).validate_python(tree["own_fence"]),
        solids=tuple(map(_solid, tree["solids"])),
        intangible=TypeAdapter(tuple[str, ...]).validate_python(tree.get("intangible", ())),
    )


def _solid(tree: dict[str, Any]) -> Solid:
    if (shape := tree["shape"]) not in SHAPES:
        raise ValueError(f"unknown shape {shape!r}")
    faces = None
    if shape == "hull":
        normals, offsets, *rest = tree["faces"]
        edges = rest[0] if rest else []  # old recordings have none
        faces = _array(normals, -1, 3), _array(offsets, len(normals)), _array(edges, -1, 2, 3)
    return Solid(
        name=str(tree["name"]),
        shape=shape,
        centre=_array(tree["centre"], 3),
        axes=_array(tree["axes"], 3, 3),
        size=_array(tree["size"], 3),
        radius=float(tree["radius"]),
        faces=faces,
    )


def _array(values: Any, *shape: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.asarray(values, dtype=np.float64).reshape(shape)
