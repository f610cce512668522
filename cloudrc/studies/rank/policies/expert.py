# SPDX-License-Identifier: Apache-2.0

"""The scripted experts of Meta-World."""

import warnings
from functools import cache
from typing import Any

from metaworld.policies import ENV_POLICY_MAP

# An expert warns of each answer beyond 1, which is clipped below.
warnings.filterwarnings("ignore", "Constant.* may be too high")


@cache
def _expert(name: str) -> Any:
    return ENV_POLICY_MAP[name]()


def infer(observation: dict[str, Any]) -> dict[str, Any]:
    """Return the action of the expert for the task `prompt`."""
    action = _expert(observation["prompt"]).get_action(observation["observation/state"])
    return {"actions": [action.clip(-1.0, 1.0)]}
