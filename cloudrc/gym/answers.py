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
    """The answers of an episode, and the observations behind them.

    An answer has a number: the tick of its observation, or, if the policy answers in every step,
    the tick in which it is asked. Then one observation may be behind several answers.
    """

    def __init__(self) -> None:
        """Begin an episode."""
        self._observations: dict[int, list[int]] = {}  # by tick: observed, sent, arrived [ns]
        # By number: tick of the observation; begun, left, received, executed [ns].
        self._answers: dict[int, list[int]] = {}
        self._newest = 0  # number of the answer that was received last

    def ask(self, tick: int, now_ns: int) -> None:
        """Note that the observation of a tick is sent at once [ns]."""
        self._observations[tick] = [now_ns, now_ns, NEVER_NS]

    def arrive(self, tick: int, at_ns: int) -> None:
        """Note the arrival of the observation of a tick [ns]."""
        self._observations[tick][ARRIVED] = at_ns

    def begin(self, number: int, tick: int, at_ns: int) -> None:
        """Note that the policy begins an answer to the observation of a tick [ns]."""
        self._answers[number] = [tick, at_ns, NEVER_NS, NEVER_NS, NEVER_NS]

    def note(self, number: int, instant: int, at_ns: int) -> None:
        """Note an instant [ns] of an answer: `LEFT` or `RECEIVED`."""
        self._answers[number][instant - ARRIVED] = at_ns
        if instant == RECEIVED:
            self._newest = number

    def execute(self, basis: float, now_ns: int) -> None:
        """Note the execution of an action in a tick that began at `now_ns` [ns].

        `basis` is the number of its answer; if several answers are behind it, the one that was
        received last counts.
        """
        number = int(basis) if basis == int(basis) else self._newest
        row = self._answers.get(number)
        if row is not None and row[-1] < 0 <= row[-2]:  # received, and not executed yet
            row[-1] = max(now_ns, row[-2])

    def table(self) -> dict[str, Instants]:
        """Return `tick` of the observation and the instants of `CUTS` [ns], each of shape (n,).

        A row is an answer, or an observation without one. -1 stands for what never happened.
        """
        answers: dict[int, list[list[int]]] = {}  # by tick of their observation
        for tick, *instants in self._answers.values():
            answers.setdefault(tick, []).append(instants)
        none = [[NEVER_NS] * 4]
        found = [
            [tick, *observed, *instants]
            for tick, observed in self._observations.items()
            for instants in answers.get(tick, none)
        ]
        columns = np.array(found, np.int64).reshape(-1, 1 + len(CUTS)).T
        return dict(zip(("tick", *CUTS), columns, strict=True))

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
