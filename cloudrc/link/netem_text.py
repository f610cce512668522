"""A direction's conditions in tc's words: a profile goes in, the words after `netem` come out.

What netem cannot do is refused by its name.

Every option is spelled out every time: `tc qdisc change` leaves the rate and the correlation that
are not named as they were.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from math import ceil

from cloudrc.errors import BadInputError
from cloudrc.link.netem_tables import distribution_name, stretch
from cloudrc.link.profile import DirectionProfile, GilbertElliott, Loss
from cloudrc.link.timeline import Conditions, Timeline

STEP_NS = 5_000_000
"""Shortest time between two steps of the qdisc [ns]; what changes faster is passed over."""
LIMIT = 10_000
"""Packets that the qdisc holds at once, as many as the relay."""
DELAY_MAX_NS = 274_000_000_000
"""tc keeps times in 64 ns ticks of 32 bits and refuses what is longer [ns]."""

_IN_ORDER = "100gbit"
"""netem lets no packet leave before the one before it as soon as it has a rate, whichever."""
_ETHERNET_BYTES = 14
"""netem counts the Ethernet header, the model does not."""
_PACKET_BITS = 8 * 116
"""A command, the smaller of our datagrams, with its headers: more of them fit into a delay."""
_PACKETS = 1_000
"""More than a tunnel sends in a second, or a probe, where no rate says how many pass [1/s]."""
_TABLE_END = 4.0
"""Longest draw of a table, in units of the jitter that tc is given."""


def check(profile: DirectionProfile) -> None:
    """Raise a BadInputError that names what netem cannot do of a profile."""
    pieces = list(_pieces(profile))
    if any(isinstance(piece.loss, GilbertElliott) and piece.loss.delay_bad for piece in pieces):
        _refuse("loss.delay_bad_ms", "more delay while a burst of losses lasts")
    if any(piece.rate and piece.jitter for piece in pieces) and not profile.keep_order:
        _refuse("rate_kbit with jitter_ms but without keep_order", "overtaking behind a bottleneck")
    if (slowest := max(piece.delay_ns for piece in pieces)) > DELAY_MAX_NS:
        _refuse("delay_ms above 274000", f"its clock ends there, here {slowest * 1e-6:g} ms")
    for blackout in profile.blackouts:
        if blackout.duration * 1e9 < STEP_NS:
            _refuse(
                f"blackouts shorter than {STEP_NS * 1e-6:g} ms",
                f"here {blackout.duration * 1e3:g} ms at {blackout.start:g} s",
            )


def notes(profile: DirectionProfile) -> list[str]:
    """Say in words what netem realises otherwise than asked."""
    said = []
    if profile.jitter and profile.correlation:
        said.append(f"netem realises next to nothing of correlation {profile.correlation:g}")
    if profile.corrupt:
        said.append(
            "netem corrupts frames, not datagrams: the receiving kernel drops most of them by "
            f"their checksums, so that corrupt {profile.corrupt:g} is seen as loss"
        )
    starts = Timeline(profile).starts_ns
    passed_over = sum(after - before < STEP_NS for before, after in pairwise(starts))
    if passed_over:
        said.append(
            f"netem is stepped every {STEP_NS * 1e-6:g} ms at most: {passed_over} of "
            f"{len(starts)} steps of the time line come sooner, and some are passed over"
        )
    return said


def options(profile: DirectionProfile, conditions: Conditions, room: int) -> list[str]:
    """Put what holds at one instant into tc's words.

    Args:
        profile: Passed `check`.
        conditions: That hold now.
        room: Its `limit`, which takes long to work out for a trace [packets].

    Returns:
        Arguments for `tc qdisc add|change ... netem`.
    """
    words = ["limit", str(room), "delay", _microseconds(conditions.delay_ns)]
    if conditions.jitter:
        words += [_microseconds(conditions.jitter * 1e9 * stretch(profile))]
        words += [_percent(profile.correlation), "distribution", distribution_name(profile)]
    words += ["loss", *_loss(1.0 if conditions.blackout else conditions.loss)]
    # Of a packet that is doubled and lost one copy arrives: in a blackout none may.
    copied = 0.0 if conditions.blackout else profile.duplicate
    words += ["duplicate", _percent(copied), "corrupt", _percent(profile.corrupt)]
    # tc refuses it without a delay, where nothing is there to be overtaken.
    if profile.reorder and conditions.delay_ns and not profile.keep_order:
        words += ["reorder", _percent(profile.reorder)]
    if conditions.rate is not None:
        return [*words, "rate", f"{conditions.rate:.0f}bit", str(-_ETHERNET_BYTES)]
    # A rate is the one way to keep the order; 0 takes back one that was given before.
    return [*words, "rate", _IN_ORDER if profile.keep_order else "0bit"]


def limit(profile: DirectionProfile) -> int:
    """Give room for what is under way at most and, behind a bottleneck, for its queue [packets].

    One number for the whole time line: a step to a shorter delay must not turn packets away
    because those of the longer one are still under way.
    """
    pieces = list(_pieces(profile))
    if all(piece.rate is None for piece in pieces):
        return LIMIT
    reach = stretch(profile) * _TABLE_END  # once: a trace has many pieces, a table many entries
    return ceil(profile.queue_packets + max(_under_way(piece, reach) for piece in pieces))


def _under_way(piece: Conditions, reach: float) -> float:
    """Say how many packets behind the bottleneck are under way at once, at most.

    Args:
        piece: Of the time line.
        reach: Longest draw, in units of the jitter [1].
    """
    longest = piece.delay_ns * 1e-9 + piece.jitter * reach
    return longest * (_PACKETS if piece.rate is None else piece.rate / _PACKET_BITS)


def _pieces(profile: DirectionProfile) -> Iterator[Conditions]:
    timeline = Timeline(profile)
    return (timeline.at(start_ns) for start_ns in timeline.starts_ns)


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
