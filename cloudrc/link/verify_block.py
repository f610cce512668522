"""Sums over what arrives in flight: a few additions per datagram, added up where it is judged."""

from __future__ import annotations

from dataclasses import dataclass
from math import nan

from cloudrc.link.verify_measure import Measured


@dataclass(slots=True)
class Block:
    """Sums over the datagrams that arrived in some seconds.

    Attributes:
        sent: Datagrams by their counters that have arrived, or will not any more.
        lost: Of them, those that did not.
        arrived: Datagrams that arrived, copies left out.
        copies: Further copies.
        late: Arrived after a newer one.
        delays: Sum of delays [s].
        squares: Sum of their squares [s^2].
        steps: Sum of absolute differences of the delays of two in a row [s].
        pairs: How many those are.
        inside: How many of the delays were in the middle, as `Frame` has it.
        places: Sum of where in it, in units of jitter [1].
        place_squares: Sum of the squares of that [1].
        trips: Sum of round trips [s].
        trip_count: How many those are.
        timed: Of those that arrived, how many had a delay.
        lateness: Sum of what this end's wakes were late and busy [s].
        late_squares: Sum of the squares of that [s^2].
        late_cubes: Sum of the cubes of that [s^3].
        wakes: How many those are.
    """

    sent: int = 0
    lost: int = 0
    arrived: int = 0
    copies: int = 0
    late: int = 0
    delays: float = 0.0
    squares: float = 0.0
    steps: float = 0.0
    pairs: int = 0
    inside: int = 0
    places: float = 0.0
    place_squares: float = 0.0
    trips: float = 0.0
    trip_count: int = 0
    timed: int = 0
    lateness: float = 0.0
    late_squares: float = 0.0
    late_cubes: float = 0.0
    wakes: int = 0

    def add(self, other: Block) -> None:
        """Take the sums of another block on top."""
        for name in self.__slots__:
            setattr(self, name, getattr(self, name) + getattr(other, name))

    def measured(self, jitter: float) -> Measured:
        """Turn sums into what probes would have measured.

        Args:
            jitter: Asked for, the unit of places [s].
        """
        place = self.places / self.inside if self.inside else nan
        spread = max(0.0, self.place_squares / self.inside - place * place) if self.inside else nan
        mean = self.delays / self.timed if self.timed else nan
        variance = max(0.0, self.squares / self.timed - mean * mean) if self.timed else nan
        return Measured(
            sent=self.sent,
            lost=self.lost,
            doubled=self.copies,
            mean=mean,
            deviation=variance**0.5,
            variation=self.steps / self.pairs if self.pairs else nan,
            reordered=self.late / self.arrived if self.arrived else nan,
            middle=spread**0.5 * jitter,
        )
