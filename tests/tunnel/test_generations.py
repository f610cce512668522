"""Generations of keys: how far ahead a peer may be, and which generations a byte stands for."""

import pytest

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import DecodeError, Kind
from cloudrc.tunnel.session import (
    AHEAD_MAX,
    FAR_MAX,
    FAR_TRIES,
    KEPT,
    REKEY_NS,
    SILENCE_NS,
    Session,
    pair,
)

BODY = bytes(codec.BODY_SIZES[Kind.COMMAND])
GENERATION = 6  # offset in the header


def after(rekeys, *, silence_ns=0):
    """Make a session in which cloud has rekeyed and world has heard nothing for `silence_ns`."""
    world, cloud = pair()
    world.maintain(0)
    world.maintain(silence_ns)
    for number in range(rekeys + 1):
        cloud.maintain(number * REKEY_NS)
    return world, cloud


def refuses(world, data):
    try:
        world.open(data)
    except DecodeError as error:
        return str(error) == "tag"
    return False


@pytest.mark.parametrize(
    ("rekeys", "silence_ns", "refused"),
    [
        (AHEAD_MAX, 0, False),
        (AHEAD_MAX + 1, 0, True),
        (AHEAD_MAX + 1, SILENCE_NS - 1, True),
        (AHEAD_MAX + 1, SILENCE_NS, False),
    ],
)
def test_a_silent_peer_may_be_many_generations_ahead(rekeys, silence_ns, refused):
    world, cloud = after(rekeys, silence_ns=silence_ns)
    assert refuses(world, cloud.seal(Kind.COMMAND, BODY)) == refused


@pytest.mark.parametrize("rekeys", [128, 255, 256, 300, 700])
def test_after_any_sleep_an_end_hears_its_peer_in_seconds(rekeys):
    """Its clock stood still in the meantime; the peer's did not."""
    world, cloud = after(rekeys, silence_ns=SILENCE_NS)
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[4] == BODY
    cloud.maintain((rekeys + 1) * REKEY_NS)
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[3] == 1
    world.maintain(2 * SILENCE_NS)
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[3] == 2


def test_generations_go_on_beyond_the_byte_of_the_header():
    world, cloud = pair()
    for number in range(600):
        cloud.maintain(number * REKEY_NS)
        assert world.open(cloud.seal(Kind.ALIVE, b""))[3] == number


def test_repeats_do_not_end_the_silence_of_a_peer():
    world, cloud = pair()
    old = cloud.seal(Kind.COMMAND, BODY)
    for data in (old, cloud.seal(Kind.COMMAND, BODY)):
        world.open(data)
    world.maintain(SILENCE_NS)
    new = cloud.seal(Kind.COMMAND, BODY)
    for heard, silent in ((new, False), (new, True), (old, True)):
        world.open(heard)
        world.maintain(world._tended_ns + SILENCE_NS)
        assert world._openers._is_silent == silent


def test_a_peer_that_has_just_been_heard_is_not_far_ahead():
    world, cloud = after(0, silence_ns=SILENCE_NS)
    world.open(cloud.seal(Kind.COMMAND, BODY))
    for number in range(AHEAD_MAX + 1):
        cloud.maintain((number + 1) * REKEY_NS)
    assert refuses(world, cloud.seal(Kind.COMMAND, BODY))


@pytest.mark.parametrize(("rekeys", "refused"), [(FAR_MAX, False), (FAR_MAX + 1, True)])
def test_the_step_ahead_counts_from_the_last_generation_heard(rekeys, refused):
    """It does not count from the first generation, which is far away after a month."""
    world, cloud = after(AHEAD_MAX)
    world.open(cloud.seal(Kind.COMMAND, BODY))
    world.maintain(1)
    world.maintain(1 + SILENCE_NS)
    for number in range(rekeys + AHEAD_MAX):
        cloud.maintain((AHEAD_MAX + 1 + number) * REKEY_NS)
    assert refuses(world, cloud.seal(Kind.COMMAND, BODY)) == refused


def test_late_datagrams_of_the_generations_before_are_opened():
    world, cloud = pair()
    cloud.maintain(0)
    late = cloud.seal(Kind.COMMAND, BODY)
    for number in range(KEPT):
        cloud.maintain((number + 1) * REKEY_NS)
    assert not refuses(world, cloud.seal(Kind.COMMAND, BODY))
    assert not refuses(world, late)


def test_a_forged_generation_opens_nothing_and_keeps_little():
    world, cloud = pair()
    for byte in range(1, 256):
        assert refuses(world, forged(cloud, byte))
    assert len(world._openers._derived) <= AHEAD_MAX
    world.maintain(1)
    assert world._openers._derived == {}


def forged(cloud, byte):
    data = bytearray(cloud.seal(Kind.COMMAND, BODY))
    data[GENERATION] = byte
    return bytes(data)


def test_during_a_silence_few_forged_generations_are_tried(monkeypatch):
    world, cloud = after(0, silence_ns=SILENCE_NS)
    derived, derive = [], Session._derive
    monkeypatch.setattr(Session, "_derive", lambda *how: (derived.append(how), derive(*how))[1])
    for _ in range(2):
        for byte in range(1, 256):
            assert refuses(world, forged(cloud, byte))
        far = len(derived) - AHEAD_MAX
        assert far == FAR_TRIES * FAR_MAX // 256
        derived.clear()
        world.maintain(world._tended_ns + 1)


def test_an_honest_peer_is_found_behind_forged_datagrams():
    world, cloud = after(300, silence_ns=SILENCE_NS)
    for byte in range(FAR_TRIES):
        assert refuses(world, forged(cloud, 200 + byte))
    honest = cloud.seal(Kind.COMMAND, BODY)
    assert refuses(world, honest)
    world.maintain(SILENCE_NS + 1)
    assert not refuses(world, honest)
