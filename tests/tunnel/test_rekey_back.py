"""Key files that differ but have one key in common: both ends change to that key."""

import pytest

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import DecodeError, Kind
from cloudrc.tunnel.keys import Key, KeySet
from cloudrc.tunnel.session import LOOKS
from tests.tunnel.test_rekey import NEW, OLD, SECOND_NS, Ends

HELLO = bytes(codec.BODY_SIZES[Kind.HELLO])


def rotated():
    """Make ends that use the new key and accept the old one for five minutes."""
    ends = Ends()
    for end in ("world", "cloud"):
        ends.rotate(end)
    ends.pass_time(5)
    assert ends.world._key == ends.cloud._key == NEW
    return ends


def go_back(ends):
    """Let only cloud return to the old key; world has heard it once with that key."""
    ends.rotate("cloud", OLD)
    ends.cloud._move_on(OLD)
    ends.world.open(ends.cloud.seal(Kind.ALIVE, b""))


def look(ends, *, heard):
    """Let world receive this and check its keys a second later."""
    ends.world.open(heard)
    ends.now_ns += SECOND_NS
    return ends.world.maintain(ends.now_ns)


@pytest.mark.parametrize("first", ["world", "cloud"])
def test_one_end_that_is_rolled_back_is_followed(first):
    """One end accepts the new key for 2 s more; the other accepts the old key for minutes."""
    ends = rotated()
    ends.rings[first].replace(KeySet(OLD, NEW, 2.0), ends.now_ns)
    ends.pass_time(3 + LOOKS)
    assert ends.world._key == ends.cloud._key == OLD
    assert ends.pass_time(10) == 10  # the other one goes on announcing the new key
    assert ends.hear_each_other()


def test_a_peer_with_the_older_key_is_given_time():
    ends = rotated()
    go_back(ends)
    for _ in range(LOOKS - 1):
        assert look(ends, heard=ends.cloud.seal(Kind.ALIVE, b"")) == []
        assert ends.world._key == NEW
    (announced,) = look(ends, heard=ends.cloud.seal(Kind.ALIVE, b""))
    assert ends.world._key == OLD
    ends.cloud.ring.replace(KeySet(NEW, OLD, 300.0), ends.now_ns)
    ends.cloud.maintain(ends.now_ns)
    ends.cloud.open(announced)
    assert look(ends, heard=ends.cloud.seal(Kind.ALIVE, b"")) == []
    assert ends.world._key == ends.cloud._key == NEW


@pytest.mark.parametrize("between", ["heard", "begun"])
def test_only_checks_in_a_row_count(between):
    ends = rotated()
    new = ends.cloud.seal(Kind.COMMAND, bytes(codec.BODY_SIZES[Kind.COMMAND]))
    go_back(ends)
    for _ in range(LOOKS - 1):
        look(ends, heard=ends.cloud.seal(Kind.ALIVE, b""))
    if between == "heard":
        look(ends, heard=new)
    else:
        for end in (ends.world, ends.cloud):
            end.begin(2, key=NEW)
        ends.cloud.maintain(ends.now_ns)
        go_back(ends)
    for _ in range(LOOKS - 1):
        look(ends, heard=ends.cloud.seal(Kind.ALIVE, b""))
    assert ends.world._key == NEW


@pytest.mark.parametrize("end", ["world", "cloud"])
def test_captured_datagrams_do_not_restore_the_old_key(end):
    ends = Ends()
    peer, end = (ends.cloud, ends.world) if end == "world" else (ends.world, ends.cloud)
    captured = peer.seal(Kind.ALIVE, b"")
    end.open(captured)
    for which in ("world", "cloud"):
        ends.rotate(which)
    ends.pass_time(5)
    for _ in range(2 * LOOKS):
        ends.pass_time(1)
        for _ in range(3):
            end.open(captured)
    assert end._key == NEW


@pytest.mark.promise("old-keys-expire")
def test_a_retired_key_opens_nothing():
    ends = rotated()
    ends.cloud._move_on(OLD)
    ends.world.open(ends.cloud.seal(Kind.ALIVE, b""))
    ends.world.ring.replace(KeySet(Key(b"m" * 32), NEW), ends.now_ns)
    for data in (ends.cloud.seal(Kind.ALIVE, b""), ends.cloud.greet(Kind.HELLO, HELLO, OLD)):
        with pytest.raises(DecodeError, match=r"^tag$"):
            ends.world.open(data)


def test_an_expired_key_is_replaced_by_the_peers_key_at_once():
    ends = Ends()
    ends.world.ring.replace(KeySet(NEW, OLD, 300.0), 0)
    ends.pass_time(1)
    ends.world._key = Key(b"x" * 32)
    ends.world.maintain(ends.now_ns)
    assert ends.world._key == OLD


def test_a_second_new_key_is_announced_in_place_of_the_first():
    ends = Ends()
    latest = Key(b"m" * 32)
    for key in (NEW, latest):
        ends.world.ring.replace(KeySet(key, OLD, 300.0), ends.now_ns)
        (announced,) = ends.world.maintain(ends.now_ns)
    ends.cloud.ring.replace(KeySet(latest, OLD, 300.0), ends.now_ns)
    ends.cloud.maintain(ends.now_ns)
    ends.cloud.open(announced)
    assert ends.cloud._key == latest
