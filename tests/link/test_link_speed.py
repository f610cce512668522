"""The time that the model needs per packet; not part of the default run."""

from __future__ import annotations

from time import process_time
from timeit import repeat

import pytest

from cloudrc.link.profile import DirectionProfile, GilbertElliott
from tests.link.conftest import SIZE, TELEMETRY, link

PACKETS = 40_000


@pytest.mark.full
@pytest.mark.parametrize(
    ("profile", "limit"),
    [
        (DirectionProfile(0.045, 0.025), 0.8e-6),
        (DirectionProfile(0.045, 0.025, "pareto", 0.5, GilbertElliott(0.01, 0.1)), 1.6e-6),
        (DirectionProfile(0.045, 0.025, keep_order=True, rate=1e7), 2.5e-6),
    ],
    ids=["plain", "lively", "queue"],
)
def test_a_packet_costs_little(profile: DirectionProfile, limit: float) -> None:
    def send_all() -> None:
        send = link(profile).send
        for n in range(PACKETS):
            send(1, TELEMETRY, n, SIZE, n * 10_000_000)

    cost = min(repeat(send_all, timer=process_time, number=1, repeat=5)) / PACKETS
    print(f"{cost * 1e6:.2f} us a packet")
    assert cost < limit
