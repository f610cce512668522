# SPDX-License-Identifier: Apache-2.0

"""Find where in its schedule a link begins: at a given time, or at one drawn at random.

Both directions begin at the same time. The draw depends on seed, episode and stream alone, so what
has these three equal meets the same part of the schedule.
"""

from __future__ import annotations

from cloudrc.link.draws import Purpose, stream_key, uniforms_of
from cloudrc.link.profile import RANDOM, DirectionProfile, Start, going_round

KIND = 131
"""Kind of the random numbers of the start."""


def draw(seed: int, episode: int, kind: int, stream: str, *, uplink: bool = True) -> float:
    """Draw one number in (0, 1) for an episode of a link; what is drawn may depend on `uplink`."""
    key = stream_key(seed, uplink, episode, kind, stream)
    return float(uniforms_of(key, Purpose.DELAY, 0, 1)[0])


def begin(
    ways: tuple[DirectionProfile, DirectionProfile],
    start: Start | None,
    seed: int,
    episode: int = 0,
    stream: str = "",
) -> tuple[DirectionProfile, DirectionProfile, int]:
    """Return uplink and downlink with the schedules they have, and where these begin [ns].

    `start` is the key `start_s` of a profile. With a start at random, the schedules repeat.
    """
    up, down = map(going_round, ways) if start == RANDOM else ways
    return up, down, start_ns((up, down), start, seed, episode, stream)


def start_ns(
    ways: tuple[DirectionProfile, DirectionProfile],
    start: Start | None,
    seed: int,
    episode: int,
    stream: str,
) -> int:
    """Return where the schedules of both directions begin in an episode [ns]."""
    if not isinstance(start, str):
        return round((start or 0.0) * 1e9)
    longest_ns = max(way.period_ns or 0 for way in ways)
    return int(draw(seed, episode, KIND, stream) * longest_ns)


def describe(start: Start | None, begins_ns: int, ways: tuple[DirectionProfile, ...]) -> str:
    """Say where the schedule begins; "" for its beginning."""
    if not begins_ns:
        return ""
    period_ns = max(way.period_ns or 0 for way in ways)
    of = f" of {period_ns / 1e9:g} s, drawn" if start == RANDOM else ""
    return f"the schedule begins at {begins_ns / 1e9:.6g} s{of}"
