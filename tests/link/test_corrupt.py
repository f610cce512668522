"""Corruption flips one bit of a datagram, chosen by its counter."""

from __future__ import annotations

from dataclasses import replace

import pytest

from cloudrc.link.draws import bit_flips, stream_key
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile, GilbertElliott

DATA = bytes(172)
PROFILE = DirectionProfile(0.04, 0.01, loss=0.1, duplicate=0.1, corrupt=0.2)


def link(profile: DirectionProfile = PROFILE) -> LinkDirection:
    return LinkDirection(profile, 7, True)


def flipped(data: bytes) -> list[int]:
    """Return the numbers of the bits that are set."""
    return [
        8 * byte + bit for byte, value in enumerate(data) for bit in range(8) if value >> bit & 1
    ]


def test_one_bit_anywhere_in_as_many_as_asked() -> None:
    one = link()
    places = [flipped(one.corrupted(1, 3, n, DATA)) for n in range(20_000)]
    hit = [place[0] for place in places if place]
    assert max(map(len, places)) == 1
    assert len(hit) / 20_000 == pytest.approx(0.2, abs=5 * (0.2 * 0.8 / 20_000) ** 0.5)
    eighths = [sum(172 * k <= place < 172 * (k + 1) for place in hit) for k in range(8)]
    assert min(eighths) > 0.8 * len(hit) / 8
    assert one.counts()["corrupted"] == len(hit)


def test_it_depends_on_the_counter_and_the_stream_alone() -> None:
    forward, backward = link(), link()
    first = [forward.corrupted(1, 3, n, DATA) for n in range(600)]
    assert first == [backward.corrupted(1, 3, n, DATA) for n in reversed(range(600))][::-1]
    assert first != [forward.corrupted(2, 3, n, DATA) for n in range(600)]
    assert first != [LinkDirection(PROFILE, 8, True).corrupted(1, 3, n, DATA) for n in range(600)]


def test_it_shifts_no_other_draw() -> None:
    bursts = replace(PROFILE, loss=GilbertElliott(0.1, 0.3), reorder=0.1, correlation=0.5)
    with_it, without = link(bursts), link(replace(bursts, corrupt=0.0))
    assert (with_it.corrupts, without.corrupts) == (True, False)
    for n in range(600):
        assert with_it.send(1, 3, n, 172, n * 1000) == without.send(1, 3, n, 172, n * 1000)


def test_an_empty_datagram_stays_as_it_is() -> None:
    assert {link().corrupted(1, 3, n, b"") for n in range(50)} == {b""}


def test_all_or_nothing() -> None:
    key = stream_key(1, True, 1, 3)
    assert len(bit_flips(key, 0, 1.0)) == 256
    assert bit_flips(key, 0, 0.0) == {}
