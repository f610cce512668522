"""What the robot has touched in a mission: contacts come in, what the verdict needs goes out."""

from __future__ import annotations

from math import hypot, isnan, nan

from cloudrc.world.readings import Touch


class Touches:
    """Of one mission.

    Attributes:
        pipes: How often the robot has begun to touch a pipe.
        speed: Of the tip when it first touched the board [m/s]; NaN if it has not yet.
    """

    def __init__(self) -> None:
        self.pipes = 0
        self.speed = nan

    def note(self, touch: Touch) -> None:
        """Take note of a contact that has begun."""
        if touch.body.startswith("pipe"):
            self.pipes += 1
        elif touch.body == "board" and touch.tip and isnan(self.speed):
            self.speed = hypot(*touch.tip_velocity)
