# SPDX-License-Identifier: Apache-2.0

"""Executors choose the action that a robot executes in each tick, from answers that arrive late.

An answer is a chunk: actions for successive ticks, the first for the tick of the observation. Each
executor is a plug-in in a file of its own. The file defines `build(**parameters)`, which returns an
`Executor`; all parameters are annotated.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from cloudrc.base import plugins

plugins.provide("executors", __name__)


class Chunk(NamedTuple):
    """What the policy sends: the actions for successive ticks."""

    basis: int  # tick of the observation to which it is the answer
    actions: tuple[Any, ...]  # as the environment takes them


class Committed(NamedTuple):
    """What the robot executes while it waits for an answer; the policy gets it."""

    actions: tuple[Any, ...] = ()  # for the ticks from that of the observation on
    delay: int = 0  # how many of them it executes, as it expects, before the answer arrives


NOTHING = Committed()


class Executor:
    """Chooses the robot's action; it runs on the robot.

    In each tick, the robot receives what has arrived, asks, receives again, and acts.

    Attributes:
        needs_chunk: Whether single actions make no sense.
        needs_floats: Whether it computes means of actions, in arrays of floating-point numbers.
        basis: Tick of the observation from which the last chosen action was computed; of several,
            their mean.
    """

    needs_chunk = True
    needs_floats = False
    basis: float = -1

    def begin(self, ticks_late: int, period_ns: int) -> None:
        """Begin an episode: the robot has sent the observation of tick 0.

        Args:
            ticks_late: Expected time from an observation to its answer, rounded up to ticks.
            period_ns: Time of a tick [ns].
        """

    def doubt(self, count: int, ticks_late: int) -> str:
        """Say why answers of `count` actions that arrive `ticks_late` ticks late make no sense.

        Return "" if they do.
        """
        return ""

    def asks(self, tick: int, observation: Any) -> bool:
        """Return whether the robot sends the observation of this tick; by default, of each."""
        return True

    def committed(self, tick: int) -> Committed:
        """Return what travels with the observation of this tick; by default, nothing."""
        return NOTHING

    def receive(self, chunk: Chunk, tick: int) -> None:
        """Take an answer that arrived before or at this tick. An older one may come later."""
        raise NotImplementedError

    def action(self, tick: int) -> Any:
        """Return the action of this tick, and set `basis`; None if there is none."""
        raise NotImplementedError
