# SPDX-License-Identifier: Apache-2.0

"""Note when an answer was asked for, made and executed: where the age of actions comes from."""

from __future__ import annotations

from math import nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

Instants = NDArray[np.int64]
STAGES = {
    "observation": "observation waits to be sent",
    "uplink": "uplink",
    "queue": "observation waits for the policy",
    "compute": "policy computes",
    "downlink": "downlink",
    "wait": "answer waits for the step",
}
"""Stages of an answer, in their order -> in words. Each begins where the one before ends."""
OBSERVED, SENT, ARRIVED, BEGUN, LEFT, RECEIVED, EXECUTED = range(7)
CUTS = ("observed", "sent", "arrived", "begun", "left", "received", "executed")
"""Names of the instants: the begin of the first stage, and the ends of all."""
NEVER_NS = -1


class Answers:
    """The answers of an episode."""

    def __init__(self) -> None:
        """Begin an episode."""
        self._rows: dict[int, list[int]] = {}
        self._newest = 0  # tick of the answer that was received last

    def ask(self, tick: int, now_ns: int) -> None:
        """Note that the observation of a tick is sent at once [ns]."""
        self._rows[tick] = [now_ns, now_ns, NEVER_NS, NEVER_NS, NEVER_NS, NEVER_NS, NEVER_NS]

    def note(self, tick: int, instant: int, at_ns: int) -> None:
        """Note an instant [ns] of the answer to the observation of a tick."""
        self._rows[tick][instant] = at_ns
        if instant == RECEIVED:
            self._newest = tick

    def execute(self, basis: float, now_ns: int) -> None:
        """Note the execution of an action in a tick that began at `now_ns` [ns].

        `basis` is the tick of its observation; if several observations are behind it, the answer
        that was received last counts.
        """
        tick = int(basis) if basis == int(basis) else self._newest
        row = self._rows.get(tick)
        if row is not None and row[EXECUTED] < 0 <= row[RECEIVED]:
            row[EXECUTED] = max(now_ns, row[RECEIVED])

    def table(self) -> dict[str, Instants]:
        """Return `tick` of the observation and the instants of `CUTS` [ns], each of shape (n,).

        -1 stands for what never happened.
        """
        rows = np.array([*self._rows.values()], np.int64).reshape(-1, len(CUTS))
        ticks = np.array([*self._rows], np.int64)
        return {"tick": ticks, **dict(zip(CUTS, rows.T, strict=True))}

    def means(self) -> dict[str, float]:
        """Return `budget_` and the name of each stage -> its mean [s] over executed answers."""
        table = self.table()
        cuts_ns = np.array([table[name] for name in CUTS])
        lengths_ns = np.diff(cuts_ns[:, cuts_ns[EXECUTED] != NEVER_NS], axis=0)
        means = (lengths_ns.mean(axis=1) * 1e-9).tolist() if lengths_ns.size else [nan] * 6
        return {f"budget_{name}": mean for name, mean in zip(STAGES, means, strict=True)}


def to_document(table: dict[str, Instants]) -> dict[str, Any]:
    """Return what `Answers.table` returns, as a file has it that `cloudrc timeline` reads.

    `ended` tells where an answer ended that was never executed; one that was still under way is
    left out.
    """
    cuts_ns, ticks = np.array([table[name] for name in CUTS]), table["tick"]
    ended = np.full(len(ticks), "", "U10")
    is_over = cuts_ns[EXECUTED] != NEVER_NS
    for cut in reversed(range(SENT, EXECUTED + 1)):
        came = cuts_ns[cut] != NEVER_NS
        is_newer = ticks > ticks[came].max(initial=-1)
        ended[~came] = "lost" if cut in (ARRIVED, RECEIVED) else "superseded"
        is_over[~came] = ~is_newer[~came]
    return {
        "schemaVersion": 1,
        "stages": STAGES,
        "ticks": ticks[is_over].tolist(),
        "cuts_ns": cuts_ns[:, is_over].tolist(),
        "ended": ended[is_over].tolist(),
    }
