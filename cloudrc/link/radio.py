# SPDX-License-Identifier: Apache-2.0

"""A radio that schedules: when a packet leaves it, in whole nanoseconds.

    T -- waits --> request slot R -- slot, grant, waits --> uplink slot -- slot, repetitions --> out

T is the time of sending on the clock of the radio. The downlink and a configured grant wait for the
next slot alone. A packet that is ready in the instant in which a slot begins takes this slot.

Source: 3GPP TS 38.214, 38.321 and 38.331 for request, grant and repetition. Deviation: all blocks
need one slot, and each repetition takes the same time.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise
from math import lcm
from typing import NamedTuple

import numpy as np

from cloudrc.link.draws import Purpose, stream_key, uniforms
from cloudrc.link.profile import DirectionProfile, Radio
from cloudrc.link.start import draw

PHASE_KIND = 134
"""Kind of the random numbers of a phase, whatever the kind of the packets."""


class RadioParts(NamedTuple):
    """The parts of the delay of a packet in the radio [ns]; their sum is the delay."""

    request_ns: int  # wait for the slot in which the packet may ask
    grant_ns: int  # from there, or from the beginning if nobody asks, to the end of its slot
    repeat_ns: int  # of all repetitions


class RadioSpan(NamedTuple):
    """Delays in the radio at random phases, without repetitions [ns]."""

    least: int  # [ns]
    mean: float  # [ns]
    most: int  # no delay reaches it [ns]


class Slots:
    """The slots of one direction of a radio.

    Attributes:
        span: Its delays at random phases.
        repeats_ns: Mean delay by repetitions [ns].
    """

    def __init__(self, radio: Radio, uplink: bool) -> None:
        """Lay out the slots of `radio` for the uplink or the downlink."""
        self._slot_ns, self._pattern_ns = round(radio.slot_ms * 1e6), radio.pattern_ns
        self._repeat_ns = round(radio.repeat_ms * 1e6)
        self._drift = radio.drift_ppm * 1e-6
        own = "U" if uplink else "D"
        places = [n for n, letter in enumerate(radio.tdd) if letter == own]
        if uplink:
            places = places[:1]
        self._starts_ns = [place * self._slot_ns for place in places]
        self._request_ns = round(radio.request_ms * 1e6) if uplink else 0
        self._granted_ns = self._slot_ns + round(radio.grant_ms * 1e6)
        self.repeats_ns = self._repeat_ns * radio.error / (1.0 - radio.error)
        self.span = self._find_span()

    def _find_span(self) -> RadioSpan:
        slot_ns, pattern_ns, asked_ns = self._slot_ns, self._pattern_ns, self._request_ns
        if asked_ns:
            least_ns = -(-self._granted_ns // pattern_ns) * pattern_ns + slot_ns
            return RadioSpan(least_ns, least_ns + asked_ns / 2, least_ns + asked_ns)
        starts_ns = [*self._starts_ns, self._starts_ns[0] + pattern_ns]
        gaps_ns = [b - a for a, b in pairwise(starts_ns)]
        mean_ns = sum(gap_ns**2 for gap_ns in gaps_ns) / (2 * pattern_ns)
        return RadioSpan(slot_ns, slot_ns + mean_ns, slot_ns + max(gaps_ns))

    def split(self, sent_ns: int, phase_ns: int, repeats: int) -> RadioParts:
        """Split the delay of a packet that is sent at `sent_ns` into its parts.

        `sent_ns` is the time on the schedule of the link [ns], `phase_ns` that of the radio when
        the schedule is at 0 [ns]; `repeats` is how often the packet is sent again.
        """
        now_ns = asks_ns = ready_ns = sent_ns + round(sent_ns * self._drift) + phase_ns
        if self._request_ns:
            asks_ns = _next_ns(now_ns, self._starts_ns[0], self._request_ns)
            ready_ns = asks_ns + self._granted_ns
        start_ns = min(_next_ns(ready_ns, each, self._pattern_ns) for each in self._starts_ns)
        granted_ns = start_ns + self._slot_ns - asks_ns
        return RadioParts(asks_ns - now_ns, granted_ns, self._repeat_ns * repeats)


def _next_ns(now_ns: int, first_ns: int, period_ns: int) -> int:
    """Return the first of `first_ns` + k `period_ns` that is not before `now_ns`."""
    return first_ns - (first_ns - now_ns) // period_ns * period_ns


def mean_delay(profile: DirectionProfile, uplink: bool) -> float:
    """Return the mean delay in the radio at random phases, with repetitions [s]; 0 without one."""
    if profile.radio is None:
        return 0.0
    found = slots_of(profile.radio, uplink)
    return (found.span.mean + found.repeats_ns) * 1e-9


slots_of = lru_cache(maxsize=64)(Slots)
"""Make `Slots`; of equal arguments, the same."""


@lru_cache(maxsize=64)
def phase_ns(radio: Radio, seed: int, uplink: bool, epoch: int, stream: str) -> int:
    """Return the time of the radio when the schedule of the link is at 0 [ns]."""
    if not isinstance(radio.phase_ms, str):
        return round(radio.phase_ms * 1e6)
    period_ns = lcm(radio.pattern_ns, round(radio.request_ms * 1e6)) or radio.pattern_ns
    return int(draw(seed, epoch, PHASE_KIND, stream, uplink=uplink) * period_ns)


@lru_cache(maxsize=64)
def repetitions(
    error: float, seed: int, uplink: bool, epoch: int, kind: int, stream: str, block: int, copy: int
) -> list[int]:
    """Draw how often each packet of a block is sent again, shape (256,); `copy` is 0 or 1.

    `error` is the chance that a block fails [1]. The number is the inverse of one uniform variate:
    it is at least n with the chance error^n.
    """
    key = stream_key(seed, uplink, epoch, kind, stream)
    share = uniforms(key, Purpose.COPY_RADIO if copy else Purpose.RADIO, block)
    if not error:
        return [0] * len(share)
    found: list[int] = (np.log(share) / np.log(error)).astype(np.int64).tolist()
    return found
