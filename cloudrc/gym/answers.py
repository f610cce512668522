# SPDX-License-Identifier: Apache-2.0

"""Note when an answer was asked for, made and executed: where the age of actions comes from."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
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

    Attributes:
        observed: Tick of each observation that was sent -> when it was observed [ns].
        arrived: Tick of each observation that arrived -> when [ns].
        begun: Number of each answer -> tick of its observation, and when it was begun [ns].
        left: Number of each answer that was sent -> when it left [ns].
        received: Number of each answer that arrived -> when [ns]; the last one is the newest.
    """

    def __init__(self) -> None:
        """Begin an episode."""
        self.observed, self.arrived = dict[int, int](), dict[int, int]()
        self.begun = dict[int, tuple[int, int]]()
        self.left, self.received = dict[int, int](), dict[int, int]()
        self._executed = dict[float, int]()

    def execute(self, basis: float, now_ns: int) -> None:
        """Note the execution of an action in a tick that began at `now_ns` [ns].

        `basis` is the number of its answer; if several answers are behind it, the one that was
        received last counts.
        """
        if basis != int(basis):
            basis = next(reversed(self.received), 0)
        if basis in self.received and basis not in self._executed:
            self._executed[basis] = max(now_ns, self.received[int(basis)])

    def _rows(self) -> Iterator[tuple[int, ...]]:
        """Yield tick of the observation and the instants of `CUTS` [ns] of each answer."""
        for number, (tick, begun_ns) in self.begun.items():
            observed_ns, ends = self.observed[tick], (self.left, self.received, self._executed)
            instants = [end.get(number, NEVER_NS) for end in ends]
            yield tick, observed_ns, observed_ns, self.arrived[tick], begun_ns, *instants

    def table(self) -> dict[str, Instants]:
        """Return `tick` of the observation and the instants of `CUTS` [ns], each of shape (n,).

        A row is an answer, or an observation without one. -1 stands for what never happened.
        """
        answers: dict[int, list[tuple[int, ...]]] = {}  # by tick of their observation
        for row in self._rows():
            answers.setdefault(row[0], []).append(row)
        found = list[tuple[int, ...]]()
        for tick, now_ns in self.observed.items():
            arrived_ns = self.arrived.get(tick, NEVER_NS)
            none = tick, now_ns, now_ns, arrived_ns, *[NEVER_NS] * 4
            found += answers.get(tick, [none])
        columns = np.array(found, np.int64).reshape(-1, 1 + len(CUTS)).T
        return dict(zip(("tick", *CUTS), columns, strict=True))

    def means(self) -> dict[str, float]:
        """Return `budget_` and the name of each stage -> its mean [s] over executed answers."""
        done = [number for number in self.begun if number in self._executed]
        ticks = [self.begun[number][0] for number in done]
        observed_ns = sum(map(self.observed.__getitem__, ticks))
        # Whole numbers: the sum of differences is the difference of sums.
        sums_ns = (
            *(observed_ns, observed_ns, sum(map(self.arrived.__getitem__, ticks))),
            sum(self.begun[number][1] for number in done),
            *(sum(map(at_ns.__getitem__, done)) for at_ns in (self.left, self.received)),
            sum(map(self._executed.__getitem__, done)),
        )
        count = len(done) or nan
        return {
            f"budget_{name}": (end_ns - begin_ns) / count * 1e-9
            for name, (begin_ns, end_ns) in zip(STAGES, pairwise(sums_ns), strict=True)
        }


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
