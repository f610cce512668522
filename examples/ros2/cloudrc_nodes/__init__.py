# SPDX-License-Identifier: Apache-2.0

"""The paper's applications as nodes of ROS 2. They do not import cloudrc.

Each node publishes what one of cloudrc's own applications publishes below `cloudrc/`. The nodes
after it then hear the node.
"""

from __future__ import annotations

from collections.abc import Collection

HEARS: dict[str, dict[str, str]] = {
    "estimator": {},
    "predictor": {"horizon": "estimator"},
    "teleop": {},
    "controller": {"estimate": "predictor", "setpoint": "teleop"},
}
"""Node -> topic that it hears -> node that may publish it, in place of cloudrc."""


def remaps(name: str, running: Collection[str]) -> list[tuple[str, str]]:
    """Return the topics to rename in the node `name`, for the nodes that are `running`."""
    return [(f"cloudrc/{topic}", topic) for topic, by in HEARS[name].items() if by in running]
