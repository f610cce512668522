"""What the ends of a flight add to the delays that they measure: how late they wake comes in.

A link is not to blame for it, nor may it hide behind it: more datagrams are taken for it.
"""

from __future__ import annotations

from dataclasses import replace
from math import hypot

from cloudrc.link.verify_block import Block
from cloudrc.link.verify_judge import Row
from cloudrc.link.verify_quantity import Quantity

PERIOD = 0.01
"""Of telemetry and of commands [s]."""
ENDS = 1e-3
"""What the ends themselves add to a delay, at most: a command's own computation, two wakes [s]."""
ENDS_LEAST = 2e-4
"""What they add at most if they wake in time: two ways through a kernel [s]."""
ENDS_SCATTER = 3e-4
"""How what they add scatters [s]."""
LATE_FACTOR = 2.0
"""The other end, whose lateness this one does not know, is taken to be as late."""


def added(block: Block, ways: int) -> float:
    """Say what the ends have added at most to a delay of one way, or of both [s].

    They are taken to be as late as this one was found to be; where that is not known, or they are
    later than they should be, to be late by ENDS for each way.
    """
    most = ways * ENDS
    if not block.wakes:
        return most
    return min(most, ways * ENDS_LEAST + LATE_FACTOR * _waited(block) / block.wakes)


def allowing(asked: Quantity, most: float) -> Quantity:
    """Allow for what ends add to a mean: half of `most` [s] is expected, and as much either side.

    Margins stay where they were: what is off by one has to be told whatever the ends add.
    """
    half = most / 2.0
    return replace(asked, expected=asked.expected + half, margin=asked.margin - half, blur=half)


def scattered(asked: Quantity) -> Quantity:
    """Allow for what ends add to a number that tells of jitter."""
    return replace(asked, blur=hypot(asked.expected, ENDS_SCATTER) - asked.expected)


def excused(row: Row, block: Block) -> Row:
    """Do not blame the link for delays that ends which wake so late may have added.

    In a wake that is late by L, L / PERIOD datagrams have waited for L / 2 in the mean: a long one
    weighs more than many short ones.
    """
    if row.verdict != "off" or not block.wakes or row.measured < row.low:
        return row
    wakes, most = block.wakes, row.high
    if row.name in ("mean", "round_trip"):
        most += LATE_FACTOR * _waited(block) / wakes
    elif row.name in ("deviation", "variation", "middle"):
        waited = max(block.late_squares, block.late_cubes / (3.0 * PERIOD))
        most = hypot(most, LATE_FACTOR * (waited / wakes) ** 0.5)
    return row._replace(verdict="open") if row.measured <= most else row


def _waited(block: Block) -> float:
    """Sum up over all wakes what datagrams have waited in them [s]."""
    return max(block.lateness, block.late_squares / (2.0 * PERIOD))
