"""A direction's conditions in tc's words: a profile goes in, the words after `netem` come out.

What netem cannot do is refused by its name.

Every option is spelled out every time: `tc qdisc change` leaves the rate and the correlation that
are not named as they were.
"""

from __future__ import annotations

from itertools import pairwise
from math import ceil

from cloudrc.errors import BadInputError
from cloudrc.link.netem_tables import STRETCH
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss
from cloudrc.link.timeline import Conditions, Timeline

STEP_NS = 20_000_000
"""How often the time line is looked at [ns]."""
LIMIT = 10_000
"""Packets that the qdisc holds at once, as many as the relay."""

_IN_ORDER = "100gbit"
"""netem lets no packet leave before the one before it as soon as it has a rate, whichever."""
_ETHERNET_BYTES = 14
"""netem counts the Ethernet header, the model does not."""
_PACKET_BITS = 8 * 200
"""The smaller of our datagrams with its headers, roughly: more of them fit into a delay."""


def check(profile: DirectionProfile) -> None:
    """Raise a BadInputError that names what netem cannot do of a profile."""
    losses = [profile.loss, *(change.loss for change in profile.changes)]
    jitters = [profile.jitter, *(change.jitter for change in profile.changes)]
    rates = [profile.rate, *(change.rate for change in profile.changes)]
    if profile.trace is not None:
        _refuse("trace", "a delay that follows a file")
    if any(isinstance(loss, GilbertElliott) and loss.delay_bad for loss in losses):
        _refuse("loss.delay_bad_ms", "more delay while a burst of losses lasts")
    if any(rates) and any(jitters) and not profile.keep_order:
        _refuse("rate_kbit with jitter_ms but without keep_order", "overtaking behind a bottleneck")
    for before_ns, after_ns in pairwise(Timeline(profile).starts_ns):
        if after_ns - before_ns < STEP_NS:
            _refuse(
                "changes or blackouts less than 20 ms apart",
                f"here {(after_ns - before_ns) * 1e-6:g} ms at {before_ns * 1e-9:g} s",
            )


def notes(profile: DirectionProfile) -> list[str]:
    """Say in words what netem realises otherwise than asked."""
    said = []
    if profile.jitter and profile.correlation:
        said.append(f"netem realises next to nothing of correlation {profile.correlation:g}")
    return said


def options(profile: DirectionProfile, conditions: Conditions) -> list[str]:
    """Put what holds at one instant into tc's words.

    Args:
        profile: Passed `check`.
        conditions: That hold now.

    Returns:
        Arguments for `tc qdisc add|change ... netem`.
    """
    words = ["limit", str(_limit(profile, conditions)), "delay", _microseconds(conditions.delay_ns)]
    if conditions.jitter:
        jitter_ns = conditions.jitter * 1e9 * STRETCH[profile.distribution]
        words += [_microseconds(jitter_ns), _percent(profile.correlation)]
        words += ["distribution", profile.distribution]
    words += ["loss", *_loss(1.0 if conditions.blackout else conditions.loss)]
    words += ["duplicate", _percent(profile.duplicate)]
    if profile.reorder and conditions.delay_ns and not profile.keep_order:
        words += ["reorder", _percent(profile.reorder)]
    if conditions.rate is not None:
        return [*words, "rate", f"{conditions.rate:.0f}bit", str(-_ETHERNET_BYTES)]
    # A rate is the one way to keep the order; 0 takes back one that was given before.
    return [*words, "rate", _IN_ORDER if profile.keep_order else "0bit"]


def _limit(profile: DirectionProfile, conditions: Conditions) -> int:
    """Room for what is under way and, behind a bottleneck, for its queue alone [packets]."""
    if conditions.rate is None:
        return LIMIT
    under_way = conditions.delay_ns * conditions.rate / (1e9 * _PACKET_BITS)
    return ceil(profile.queue_packets + under_way)


def _loss(loss: Loss) -> list[str]:
    if isinstance(loss, GilbertElliott):
        chances = (loss.bad_start, loss.bad_end, loss.loss_bad, loss.loss_good)
        return ["gemodel", *map(_percent, chances)]
    return ["random", _percent(loss)]


def _microseconds(duration_ns: float) -> str:
    return f"{duration_ns * 1e-3:.3f}us"  # iproute2 before 6.2 knows no "ns"


def _percent(share: float) -> str:
    return f"{100.0 * share:.9g}%"


def _refuse(key: str, meaning: str) -> None:
    raise BadInputError(
        f"netem cannot do {key} ({meaning}); set link.mode=relay, which can, or leave it out"
    )
