"""A probe of the link is no datagram of the tunnel, whoever sends it: refused and counted."""

from cloudrc.link.verify.probe import PROBE
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Direction, Kind
from tests.tunnel.hostile import Target


def test_no_end_takes_a_probe_for_a_datagram_or_answers_it():
    """Headers in the clear before nothing, of every length that a datagram of the tunnel has."""
    assert PROBE not in set(Kind)
    target = Target()
    sent = [
        codec.encode_header(PROBE, direction, epoch, counter).ljust(size, b"\0")
        for size in sorted({codec.HEADER_SIZE, *codec.SIZES.values(), codec.DATAGRAM_MAX})
        for direction in Direction
        for epoch in (0, 1, 2)
        for counter in (0, 1, 1 << 40)
    ]
    before = [end._counts["malformed"] for end in (target.world, target.cloud)]
    for data in sent:
        assert codec.peek(data)[0] == PROBE, "the link tells them apart"
        target.world.receive_datagram(data, 0)
        target.cloud.receive_datagram(data, 0)
    target.check()  # nothing accepted, nothing answered, no session touched
    for end, count in zip((target.world, target.cloud), before, strict=True):
        assert end._counts["malformed"] - count == len(sent)
