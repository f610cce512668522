"""What datagrams show on the link that a shaper says it makes: a profile in, numbers out."""

from __future__ import annotations

from collections.abc import Iterator
from math import nan

from cloudrc.link.profile import DirectionProfile, mean_loss
from cloudrc.link.verify_corrupt import refusing
from cloudrc.link.verify_ends import PERIOD
from cloudrc.link.verify_expect import Schedule, draw_batches
from cloudrc.link.verify_judge import Row
from cloudrc.link.verify_netem import netem_makes
from cloudrc.link.verify_rate import RATE_SHARE
from cloudrc.link.verify_standing import BATCHES


def shown(applied: DirectionProfile, size: int, shaper: str) -> dict[str, float]:
    """Work out what the tunnel's own datagrams show, as the standing check does; takes 50 ms.

    Args:
        applied: What is in force, for ever.
        size: Of each datagram, UDP payload [bytes].
        shaper: "relay" or "netem".

    Returns:
        By the name of the row: [s] or [1].
    """
    profile = netem_makes(applied) if shaper == "netem" else refusing(applied)
    found = draw_batches(profile, Schedule(PERIOD, 0, size), BATCHES).estimates(None)
    shares = {"loss": mean_loss(profile.loss), "duplicated": profile.duplicate}
    return {name: one.value for name, one in found._asdict().items()} | shares


def rate_in_force(asked: float, applied: float) -> Iterator[Row]:
    """Judge a rate that nobody measures by what the shaper says; nothing if that is right.

    Args:
        asked: Of the bottleneck [bit/s].
        applied: By the shaper's word [bit/s]; infinite without one.
    """
    low, high = (1.0 - RATE_SHARE) * asked, (1.0 + RATE_SHARE) * asked
    if not low <= applied <= high:
        yield Row("rate", "bit/s", asked, applied, nan, low, high, "off")
