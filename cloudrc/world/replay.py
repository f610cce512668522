"""The benchmark's yardstick: a tape of the very same controls in, the same end state out, in C.

How fast `replay` runs is how fast raw `mj_step` can be; that both end in the same bits shows that
the comparison is fair.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from cloudrc.world.scene import mujoco
from cloudrc.world.simulator import State


def replay(model: Any, start: State, tape: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Play a `Simulator.tape` again with `mujoco.rollout`, one thread.

    Args:
        model: `Simulator.model`.
        start: `Simulator.state()` when the tape began.
        tape: Thrusts [N] and applied wrench [N], [N m] of every step; no reset in between.

    Returns:
        The physics of `Simulator.state()` at the end, shape (n,).
    """
    from mujoco import rollout

    state = mujoco.mjtState
    physics, _ = rollout.rollout(
        model,
        mujoco.MjData(model),
        start.physics,
        np.asarray(tape),
        control_spec=state.mjSTATE_CTRL | state.mjSTATE_QFRC_APPLIED,
        initial_warmstart=start.warmstart,
    )
    end: npt.NDArray[np.float64] = physics[0, -1]
    return end
