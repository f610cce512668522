# SPDX-License-Identifier: Apache-2.0

"""Check the actions of a policy, wherever it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cloudrc.base.outside.values import RESULT, InvalidValueError, shorten, to_arrays

ACTIONS = "actions"
"""Key of an answer: the chunk of actions, shape (H, A)."""
HORIZON_MAX = 10_000
"""Largest number of actions in a chunk."""


class PolicyAnswerError(ValueError):
    """A policy answered with something else than actions."""


def read_actions(
    answer: Any, width: int | None = None, *, may_switch: bool = False
) -> NDArray[Any]:
    """Return the actions of a policy's answer, shape (H, A), H > 0; raise a PolicyAnswerError.

    `width` is A, if it is known. All values are finite numbers; with `may_switch` they may also all
    be booleans.
    """
    if not isinstance(answer, Mapping):
        raise PolicyAnswerError(f"the answer is {shorten(answer)}, not a map with '{ACTIONS}'")
    if ACTIONS not in answer:
        keys = ", ".join(sorted(map(str, answer))) or "none"
        raise PolicyAnswerError(f"the answer has no key '{ACTIONS}'; its keys: {keys[:200]}")
    given = to_arrays(answer[ACTIONS])
    try:
        is_switch = may_switch and isinstance(given, np.ndarray) and given.dtype.kind == "b"
        actions = given if is_switch else RESULT.array(given)
    except InvalidValueError as error:
        raise PolicyAnswerError(f"'{ACTIONS}': {error}") from None
    wanted = f"(H, {'A' if width is None else width})"
    is_chunk = actions.ndim == 2 and 0 < len(actions) <= HORIZON_MAX and actions.shape[1] > 0
    if not is_chunk or width not in (None, actions.shape[1]):
        raise PolicyAnswerError(f"'{ACTIONS}' has the shape {actions.shape}, not {wanted}")
    return actions
