"""Numbers of a link in a sentence: rows and values come in, words go out."""

from __future__ import annotations

from math import isnan

from cloudrc.link.profile import DirectionProfile
from cloudrc.link.verify_judge import Row


def said(mean: Row, applied: DirectionProfile | None) -> str:
    """Say whether the shaper did what it was told, if it tells."""
    if applied is None or isnan(mean.applied):
        return ""
    # Clearly nearer: of a sample's mean and one in the long run either may be so by chance.
    if abs(mean.applied - mean.measured) < 0.5 * abs(mean.asked - mean.measured):
        return f"; the shaper says {ms(mean.applied)}: it was told so"
    return f"; the shaper says {ms(mean.applied)}"


def times(mean: Row) -> str:
    """Say how many times what was asked a mean is."""
    if not mean.asked:
        return f"the mean is {ms(mean.measured)}, none was asked for"
    return f"the mean is {ms(mean.measured)}, {mean.measured / mean.asked:.2f} times what was asked"


def ms(value: float) -> str:
    """Write a value [s] in milliseconds."""
    return f"{value * 1e3:.2f} ms"


def kbit(value: float) -> str:
    """Write a value [bit/s] in kbit/s."""
    return "no limit" if value > 1e12 else f"{value * 1e-3:.0f} kbit/s"
