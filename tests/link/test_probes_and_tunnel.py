"""A probe of the link is no datagram of the tunnel, whoever sends it: refused and counted."""

from __future__ import annotations

import pytest

from cloudrc.cli.link_verify import make_plans
from cloudrc.config.load import load_experiment
from cloudrc.link.verify.probe import PROBE
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import DecodeError, Direction, Kind
from tests.tunnel.hostile import Target

KINDS = (PROBE,)


def probes(kind: int) -> list[bytes]:
    """Headers in the clear before nothing, of every length that a datagram of the tunnel has."""
    sizes = sorted({codec.HEADER_SIZE, *codec.SIZES.values(), codec.DATAGRAM_MAX})
    return [
        codec.encode_header(kind, direction, epoch, counter).ljust(size, b"\0")
        for size in sizes
        for direction in Direction
        for epoch in (0, 1, 2)
        for counter in (0, 1, 1 << 40)
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_no_end_takes_a_probe_for_a_datagram_or_answers_it(kind: int) -> None:
    target = Target()
    sent = probes(kind)
    before = [end._counts["malformed"] for end in (target.world, target.cloud)]
    for data in sent:
        target.world.receive_datagram(data, 0)
        target.cloud.receive_datagram(data, 0)
    target.check()  # nothing accepted, nothing answered, no session touched
    for end, count in zip((target.world, target.cloud), before, strict=True):
        assert end._counts["malformed"] - count == len(sent)


@pytest.mark.parametrize("kind", KINDS)
def test_no_kind_of_the_tunnel_is_a_probes(kind: int) -> None:
    assert kind not in set(Kind)
    for data in probes(kind):
        assert codec.peek(data)[0] == kind, "the link tells them apart"
        with pytest.raises(DecodeError, match="malformed"):
            codec.check(data)


def test_probes_are_as_long_as_what_flies_there() -> None:
    asked = make_plans(load_experiment("paper"), 5.0, "relay")
    flies = {"uplink": Kind.TELEMETRY, "downlink": Kind.COMMAND}
    for way, kind in flies.items():
        assert asked[way].flow.size == codec.SIZES[kind]
