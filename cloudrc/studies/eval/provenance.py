# SPDX-License-Identifier: Apache-2.0

"""Say how the numbers of an evaluation were made, so that they can be cited and repeated."""

from __future__ import annotations

import platform
import sys
from dataclasses import asdict, replace
from datetime import UTC, datetime
from typing import Any

from cloudrc.base import source
from cloudrc.link.library import read_profile
from cloudrc.link.profile import DirectionProfile
from cloudrc.results.report.document import versions
from cloudrc.studies.eval.setup import EvalSetup
from cloudrc.version import __version__
from cloudrc.wire.pictures import describe_codec

LIBRARIES = ("gymnasium", "numpy", "torch", "jax", "mujoco", "pybullet", "pymunk", "Box2D")
"""Packages that may decide what an environment and a policy do; those that are loaded are named."""
CITE = (
    f'The cloudrc authors, "cloudrc: a testbed for robots that are controlled from the cloud", '
    f"version {__version__} (code {source.code_hash()}), after A. S. Seisa, "
    "V. N. Sankaranarayanan, G. Damigos, S. G. Satpute and G. Nikolakopoulos, "
    '"Cloud-Assisted Remote Control for Aerial Robots: From Theory to Proof-of-Concept '
    'Implementation", CCGridW 2025, https://arxiv.org/abs/2509.04095.'
)


def provenance(setup: EvalSetup, command: str) -> dict[str, Any]:
    """Return versions, command, time, link and citation of an evaluation that has been played."""
    link, top = read_profile(setup.link), setup.env.partition(":")[0].partition(".")[0]
    return {
        "versions": {
            "python": platform.python_version(),
            **versions(["cloudrc", *(each for each in (*LIBRARIES, top) if each in sys.modules)]),
            **({"codec": describe_codec(setup.codec.partition(":")[0])} if setup.codec else {}),
        },
        "command": command,
        "date": f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC",
        "profile": {
            name: _keys(way) for name, way in (("uplink", link.uplink), ("downlink", link.downlink))
        },
        "cite": CITE,
    }


def _keys(way: DirectionProfile) -> dict[str, Any]:
    """Return the keys of a direction without the contents of files; `radio` if there is one."""
    keys = asdict(replace(way, rows=None, quantiles=(), opportunities=()))
    return {key: value for key, value in keys.items() if key != "radio" or value}
