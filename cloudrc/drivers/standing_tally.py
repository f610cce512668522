"""What the standing check makes of single datagrams: arrivals come in, sums and a log go out."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from math import nan

from cloudrc.exposition.parts import Stream
from cloudrc.link.verify_block import Block
from cloudrc.link.verify_twin import Heard
from cloudrc.records import Arrival
from cloudrc.tunnel.channel import LATE, REPEATED, Channel

HEARD_MAX = 4000
"""Datagrams that are kept one by one: those of 40 s."""
_RING = 256


def _nowhere(delay: float) -> float:
    return nan


class Tally:
    """Sums over what arrives in one direction, and its newest datagrams.

    Attributes:
        block: Sums since they were taken.
        heard: Datagrams one by one, oldest first.
        epoch: Of the session.
        place: Says where in the middle a delay is; see `Standing.place`.
    """

    def __init__(self) -> None:
        """Begin before the first datagram."""
        self.block = Block()
        self.heard: deque[Heard] = deque(maxlen=HEARD_MAX)
        self.epoch = -1
        self.place: Callable[[float], float] = _nowhere
        self._channel = Channel(newest_wins=True)
        self._stream = Stream()
        self._told = (0, 0)
        self._delays: list[tuple[int, float]] = [(-1, 0.0)] * _RING

    def see(self, arrival: Arrival) -> bool:
        """Add one datagram; True if it is the first of its session."""
        stamp_ns, _, epoch, counter, delay, _ = arrival
        self._stream.take(epoch, counter)
        if epoch != self.epoch:
            self.epoch = epoch
            self._channel.reset()
            self._channel.take(counter)
            return True
        self.heard.append((stamp_ns, counter, delay))
        block, outcome = self.block, self._channel.take(counter)
        if outcome == REPEATED:
            block.copies += 1
            return False
        block.arrived += 1
        if outcome == LATE:
            block.late += 1
        if delay == delay:  # not NaN
            self._add_delay(counter, delay)
        return False

    def _add_delay(self, counter: int, delay: float) -> None:
        block, delays = self.block, self._delays
        block.timed += 1
        block.delays += delay
        block.squares += delay * delay
        place = self.place(delay)
        if place == place:
            block.inside += 1
            block.places += place
            block.place_squares += place * place
        delays[counter % _RING] = (counter, delay)
        for neighbour in (counter - 1, counter + 1):
            known, other = delays[neighbour % _RING]
            if known == neighbour:
                block.steps += abs(delay - other)
                block.pairs += 1

    def take(self) -> Block:
        """Hand over the sums and begin new ones."""
        block, self.block = self.block, Block()
        (sent, lost), self._told = self._told, (self._stream.expected, self._stream.lost)
        block.sent, block.lost = self._told[0] - sent, self._told[1] - lost
        return block

    def forget(self) -> None:
        """Begin anew, within the same session."""
        self.take()
        self.heard.clear()
