"""Largest height of the robot."""

UNIT = "m"


def measure(flight):
    return flight.control["measured"][:, 2].max()
