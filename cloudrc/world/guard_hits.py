"""How the guard feels a hit: readings in, out comes what tells that the robot has met something.

The guard knows neither pipes nor board. A robot that has been flown into one at speed needs up to a
second to get its attitude back, and meanwhile its rotors push it wherever they point, faster and
faster; without them it falls, and lies within a stretch that can be told before. None of this
happens to a robot that touches nothing, whatever it is commanded: the limits are beyond that.
"""

from __future__ import annotations

from cloudrc.messages import NEVER_NS, ZERO, Cause
from cloudrc.world.readings import Readings

UPSET = 0.2
"""Cosine of the tilt; the worst commands get to 0.4 without a hit [1]."""
SPIN_MAX = 3.0
"""Yaw rate [rad/s]; no command asks for it."""
TUMBLE_MAX = 7.0
"""Rate of roll and pitch [rad/s]; the worst commands get to 5.4 without a hit."""
JOLT, PULL = 0.8, 40.0e-9
"""How much a component of the velocity changes at once [m/s]: a hasty touch of the board takes off
0.5. The rotors add this in time [m/s per ns]."""


class Hits:
    """Compares what is sensed now with what was sensed last."""

    def __init__(self) -> None:
        """Begin with nothing to compare with."""
        self.forget()

    def forget(self) -> None:
        """What comes next is another flight."""
        self._velocity, self._seen_ns = ZERO, NEVER_NS

    def felt(self, now_ns: int, readings: Readings) -> Cause | None:
        """Say what has befallen the robot since the last call; None if nothing has.

        Args:
            now_ns: World's clock [ns].
            readings: Of the sensors on board.
        """
        _, _, (vx, vy, vz), (p, q, r), axes = readings
        (ux, uy, uz), seen_ns = self._velocity, self._seen_ns
        self._velocity, self._seen_ns = readings.velocity, now_ns
        if axes[8] < UPSET:
            return Cause.OVERTURNED
        if abs(r) > SPIN_MAX or p * p + q * q > TUMBLE_MAX * TUMBLE_MAX:
            return Cause.SPUN
        most = JOLT + PULL * (now_ns - seen_ns)
        if seen_ns != NEVER_NS and (
            abs(vx - ux) > most or abs(vy - uy) > most or abs(vz - uz) > most
        ):
            return Cause.JOLTED
        return None
