"""Sessions and channels: which datagram belongs to us, and which one counts."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.tunnel import codec
from cloudrc.tunnel.channel import LATE, REPEATED, USED, WINDOW, Channel
from cloudrc.tunnel.codec import DecodeError, Direction, Kind
from cloudrc.tunnel.session import NO_EPOCH, Session

BODY = bytes(codec.BODY_SIZES[Kind.COMMAND])


def test_the_other_end_opens_what_one_end_seals():
    cloud, world = Session(Direction.DOWNLINK), Session(Direction.UPLINK)
    cloud.begin(7)
    cloud.seal(Kind.COMMAND, BODY)
    assert world.open(cloud.seal(Kind.COMMAND, BODY)) == (
        Kind.COMMAND,
        Direction.DOWNLINK,
        7,
        1,
        BODY,
    )


def test_an_end_does_not_open_its_own_datagrams():
    cloud = Session(Direction.DOWNLINK)
    with pytest.raises(DecodeError, match="direction"):
        cloud.open(cloud.seal(Kind.COMMAND, BODY))


def test_kinds_count_on_their_own_and_an_epoch_begins_them_anew():
    session = Session(Direction.DOWNLINK)
    session.begin(1)
    session.seal(Kind.COMMAND, BODY)
    assert session.next_counter(Kind.COMMAND) == 1
    assert session.next_counter(Kind.OPERATOR) == 0
    session.begin(2)
    assert session.next_counter(Kind.COMMAND) == 0


def test_hellos_belong_to_no_epoch_and_count_on():
    session = Session(Direction.DOWNLINK)
    hello = bytes(codec.BODY_SIZES[Kind.HELLO])
    session.seal(Kind.HELLO, hello)
    session.begin(5)
    _, _, epoch, counter, _ = codec.decode(session.seal(Kind.HELLO, hello))
    assert (epoch, counter) == (NO_EPOCH, 1)


def test_newest_wins_and_the_last_to_arrive_wins():
    newest, arrival = Channel(newest_wins=True), Channel(newest_wins=False)
    order = [0, 2, 1, 2, 3]
    used, late, repeated = USED, LATE, REPEATED
    assert [newest.take(n) for n in order] == [used, used, late, repeated, used]
    assert [arrival.take(n) for n in order] == [used, used, used, repeated, used]


def test_what_is_too_old_to_remember_counts_as_repeated():
    channel = Channel(newest_wins=True)
    channel.take(WINDOW)
    assert channel.take(1) == LATE
    assert channel.take(0) == REPEATED
    assert channel.take(1) == REPEATED


def test_a_jump_over_the_window_forgets_what_was_before():
    channel = Channel(newest_wins=True)
    channel.take(3)
    assert channel.take(2**64 - 1) == USED
    assert channel.take(4) == REPEATED


@given(st.lists(st.integers(0, 40), max_size=60), st.booleans())
@settings(max_examples=80, deadline=None)
def test_the_window_agrees_with_a_set(counters, newest_wins):
    channel, seen = Channel(newest_wins), set()
    for counter in counters:
        if counter in seen:
            expected = REPEATED
        elif newest_wins and seen and counter < max(seen):
            expected = LATE
        else:
            expected = USED
        seen.add(counter)
        assert channel.take(counter) == expected


def test_a_new_epoch_forgets_all_counters():
    channel = Channel(newest_wins=True)
    channel.take(9)
    channel.reset()
    assert channel.take(0) == USED
