# SPDX-License-Identifier: Apache-2.0

"""What a recording keeps of robot and scene, so that its report needs none of the user's files."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from cloudrc.base.outside.refusal import reading
from cloudrc.config.world import WorldFiles
from cloudrc.physics.geometry.clearance import Spheres
from cloudrc.physics.geometry.fence import Fence
from cloudrc.physics.geometry.moving import Moving
from cloudrc.physics.geometry.obstacles import fence_of
from cloudrc.physics.geometry.scene import Plate, Scene, Tube
from cloudrc.physics.geometry.solids import Solid

FLOWN_FILE = "geometry.json"
"""Name of the attachment of a recording."""


@dataclass(frozen=True)
class FlownWorld:
    """Robot and scene of a flight, as numbers."""

    scene: Scene
    hull: Spheres | None  # of the robot; None: not known
    planar: bool  # whether the robot stays on the ground

    @staticmethod
    def of(files: WorldFiles) -> FlownWorld:
        """Return the numbers of a robot and its scene as their files are now."""
        return FlownWorld(files.scene, files.known_hull, files.robot.planar)

    @property
    def steered(self) -> Fence:
        """Fence inside which an operator steers; for a planar robot, at its height only."""
        return fence_of(self.scene, planar=self.planar)

    def to_bytes(self) -> bytes:
        """Return the content of a file, which `from_bytes` reads: every number is kept exactly."""
        scene = asdict(replace(self.scene, path=None, own_fence=fence_of(self.scene)))
        if not self.scene.moving:  # scenes without one keep their bytes
            del scene["moving"]
        hull = None if self.hull is None else self.hull._asdict()
        tree = {"scene": scene, "hull": hull, "planar": self.planar}
        return json.dumps(tree, default=lambda array: array.tolist()).encode()

    @staticmethod
    def from_bytes(data: bytes) -> FlownWorld:
        """Read the content of a file; raise a BadInputError if it is not readable."""
        with reading(FLOWN_FILE, "is not readable"):
            tree = _frozen(json.loads(data))
            hull = tree["hull"] and Spheres(
                **{key: np.array(each) for key, each in tree["hull"].items()}
            )
            return FlownWorld(_scene(tree["scene"]), hull, tree["planar"])


def _frozen(value: Any) -> Any:
    """Return a value of JSON with tuples in place of lists."""
    if isinstance(value, dict):
        return {key: _frozen(each) for key, each in value.items()}
    return tuple(map(_frozen, value)) if isinstance(value, list) else value


def _scene(tree: dict[str, Any]) -> Scene:
    parts = {
        "tubes": tuple(Tube(**each) for each in tree["tubes"]),
        "plates": tuple(Plate(**each) for each in tree["plates"]),
        "own_fence": Fence(**tree["own_fence"]),
        "solids": tuple(map(_solid, tree["solids"])),
        "moving": tuple(Moving(**each) for each in tree.get("moving", ())),
    }
    return Scene(**tree | parts)


def _solid(tree: dict[str, Any]) -> Solid:
    arrays = {key: np.array(tree[key]) for key in ("centre", "axes", "size")}
    faces = tree["faces"] and tuple(map(np.array, tree["faces"]))
    return Solid(tree["name"], tree["shape"], **arrays, faces=faces)
