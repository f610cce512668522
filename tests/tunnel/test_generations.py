"""Generations of keys: how far a peer may have moved on, and what a byte of them stands for."""

import pytest

from cloudrc.tunnel import codec, session
from cloudrc.tunnel.codec import DecodeError, Kind
from cloudrc.tunnel.session import REKEY_NS, pair

BODY = bytes(codec.BODY_SIZES[Kind.COMMAND])
GENERATION = 6  # where it stands in the header


@pytest.mark.parametrize(("ahead", "opened"), [(127, True), (128, False)])
def test_a_peer_may_be_far_ahead_after_a_long_silence(ahead, opened):
    world, cloud = pair()
    for number in range(ahead + 1):
        cloud.tend(number * REKEY_NS)
    data = cloud.seal(Kind.COMMAND, BODY)
    if opened:
        assert world.open(data)[4] == BODY
    else:
        with pytest.raises(DecodeError, match=r"^tag$"):
            world.open(data)


@pytest.mark.parametrize("ahead", [128, 255, 256, 300, 700])
def test_after_a_longer_silence_the_byte_of_the_header_stands_for_several_generations(ahead):
    """By the clock of who has heard nothing for so long."""
    world, cloud = pair()
    world.tend(0)
    for number in range(ahead + 1):
        cloud.tend(number * REKEY_NS)
    world.tend(ahead * REKEY_NS)
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[4] == BODY
    cloud.tend((ahead + 1) * REKEY_NS)
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[3] == 1


def test_generations_go_on_beyond_the_byte_of_the_header():
    world, cloud = pair()
    for number in range(600):
        cloud.tend(number * REKEY_NS)
        assert world.open(cloud.seal(Kind.ALIVE, b""))[3] == number


def test_a_forged_generation_opens_nothing_and_keeps_little():
    world, cloud = pair()
    data = bytearray(cloud.seal(Kind.COMMAND, BODY))
    for byte in range(1, 256):
        data[GENERATION] = byte
        with pytest.raises(DecodeError, match=r"^tag$"):
            world.open(bytes(data))
    assert len(world._tried) <= session.AHEAD_MAX
    world.tend(1)
    assert world._tried == {}
