"""Key files that differ and have one key in common: the ends come together on that one."""

import pytest
from test_rekey import NEW, OLD, SECOND_NS, Ends

from cloudrc.tunnel.codec import Kind
from cloudrc.tunnel.keys import Key, KeySet
from cloudrc.tunnel.session import LOOKS


def rotated():
    """Both ends use the new key, and accept the one before for five minutes."""
    ends = Ends()
    for end in ("world", "cloud"):
        ends.rotate(end)
    ends.pass_time(5)
    assert ends.world._key == ends.cloud._key == NEW
    return ends


def go_back(ends):
    """Cloud alone seals with the old key again, and has been heard with it once."""
    ends.rotate("cloud", OLD)
    ends.cloud._move_on(OLD)
    ends.world.open(ends.cloud.seal(Kind.ALIVE, b""))


def look(ends, *, heard):
    """World looks, a second later, after it has heard this."""
    ends.world.open(heard)
    ends.now_ns += SECOND_NS
    return ends.world.tend(ends.now_ns)


@pytest.mark.promise("P-LINK-5")
@pytest.mark.parametrize("first", ["world", "cloud"])
def test_one_end_that_is_rolled_back_is_followed(first):
    """It knows the new key for two seconds more, the other one the old key for minutes."""
    ends = rotated()
    ends.rings[first].replace(KeySet(OLD, NEW, 2.0), ends.now_ns)
    ends.pass_time(3 + LOOKS)
    assert ends.world._key == ends.cloud._key == OLD
    assert ends.pass_time(10) == 10  # the other one goes on announcing the new key
    assert ends.hear_each_other()


def test_a_peer_that_is_heard_with_the_key_before_is_given_time():
    ends = rotated()
    go_back(ends)
    for _ in range(LOOKS - 1):
        assert look(ends, heard=ends.cloud.seal(Kind.ALIVE, b"")) == []
        assert ends.world._key == NEW
    (announced,) = look(ends, heard=ends.cloud.seal(Kind.ALIVE, b""))
    assert ends.world._key == OLD
    ends.cloud.ring.replace(KeySet(NEW, OLD, 300.0), ends.now_ns)
    ends.cloud.tend(ends.now_ns)
    ends.cloud.open(announced)
    assert look(ends, heard=ends.cloud.seal(Kind.ALIVE, b"")) == []
    assert ends.world._key == ends.cloud._key == NEW


@pytest.mark.parametrize("between", ["heard", "begun"])
def test_the_looks_are_counted_in_a_row(between):
    ends = rotated()
    new = ends.cloud.seal(Kind.ALIVE, b"")
    go_back(ends)
    for _ in range(LOOKS - 1):
        look(ends, heard=ends.cloud.seal(Kind.ALIVE, b""))
    if between == "heard":
        look(ends, heard=new)
    else:
        for end in (ends.world, ends.cloud):
            end.begin(2, key=NEW)
        ends.cloud.tend(ends.now_ns)
        go_back(ends)
    for _ in range(LOOKS - 1):
        look(ends, heard=ends.cloud.seal(Kind.ALIVE, b""))
    assert ends.world._key == NEW


def test_a_key_that_is_not_valid_any_more_is_left_at_once_for_the_one_that_is_heard():
    ends = Ends()
    ends.world.ring.replace(KeySet(NEW, OLD, 300.0), 0)
    ends.pass_time(1)
    ends.world._key = Key(b"x" * 32)
    ends.world.tend(ends.now_ns)
    assert ends.world._key == OLD
