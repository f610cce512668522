"""Damaged datagrams as losses: what is asked goes in, what an end sees that refuses them comes out.

The tunnel refuses a datagram whose tag does not fit, and the kernel one whose checksum does not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss, mean_loss


def refusing(profile: DirectionProfile) -> DirectionProfile:
    """Give the profile that an end meets which refuses what is damaged: nothing is, more is lost.

    Args:
        profile: Its `corrupt` flips a bit in that share of the datagrams, all copies alike.
    """
    whole = 1.0 - profile.corrupt
    if whole == 1.0:
        return profile

    def joined(loss: Loss) -> Loss:
        if isinstance(loss, GilbertElliott):
            bad, good = (1.0 - (1.0 - one) * whole for one in (loss.loss_bad, loss.loss_good))
            return replace(loss, loss_bad=bad, loss_good=good)
        return 1.0 - (1.0 - loss) * whole

    return replace(each_loss(profile, joined), corrupt=0.0)


def each_loss(profile: DirectionProfile, made: Callable[[Loss], Loss]) -> DirectionProfile:
    """Put another loss in place of each that a profile asks for, at any time."""
    changes = tuple(
        replace(change, loss=None if change.loss is None else made(change.loss))
        for change in profile.changes
    )
    trace = profile.trace
    if trace is not None and trace.losses is not None:
        trace = replace(trace, losses=tuple(mean_loss(made(loss)) for loss in trace.losses))
    return replace(profile, loss=made(profile.loss), changes=changes, trace=trace)
