"""New keys in flight: every 120 s, after 2^32 datagrams, and when the key file is rotated."""

import random

import pytest

from cloudrc.tunnel import codec, session
from cloudrc.tunnel.codec import DecodeError, Direction, Kind
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import KEPT, REKEY_NS, Agreement, Session, pair

BODY = bytes(codec.BODY_SIZES[Kind.COMMAND])
SECOND_NS = 1_000_000_000
OLD, NEW, WRONG = Key(b"o" * 32), Key(b"n" * 32), Key(b"w" * 32)
GENERATION = 6  # offset in the header


class Ends:
    """World and cloud of one session, each with its own key file."""

    def __init__(self, overlap=300.0):
        self.rings = {end: KeyRing(KeySet(OLD)) for end in ("world", "cloud")}
        self.overlap, self.now_ns = overlap, 0
        self.world = Session(Direction.UPLINK, self.rings["world"])
        self.cloud = Session(Direction.DOWNLINK, self.rings["cloud"])
        for end in (self.world, self.cloud):
            end.begin(1, Agreement(b"c" * 16, b"w" * 16))
            end.maintain(0)

    def rotate(self, end, key=NEW):
        self.rings[end].replace(KeySet(key, None, self.overlap), self.now_ns)

    def hear_each_other(self):
        """Whether what either end seals now is opened by the other."""
        for end, other in ((self.world, self.cloud), (self.cloud, self.world)):
            try:
                other.open(end.seal(Kind.ALIVE, b""))
            except DecodeError:
                return False
        return True

    def pass_time(self, seconds, *, deliver=True):
        """Every second both ends tend to themselves and send one datagram; what is refused."""
        refused = 0
        for _ in range(seconds):
            self.now_ns += SECOND_NS
            for end, other in ((self.world, self.cloud), (self.cloud, self.world)):
                for data in [*end.maintain(self.now_ns), end.seal(Kind.ALIVE, b"")]:
                    if deliver:
                        try:
                            other.open(data)
                        except DecodeError:
                            refused += 1
        return refused


def generation(data):
    return data[GENERATION]


@pytest.mark.promise("keys-change-in-flight")
def test_a_rekey_after_two_minutes_loses_no_datagram():
    ends = Ends()
    assert ends.pass_time(119) == 0
    assert generation(ends.cloud.seal(Kind.COMMAND, BODY)) == 0
    assert ends.pass_time(2) == 0
    assert generation(ends.cloud.seal(Kind.COMMAND, BODY)) == 1
    assert ends.pass_time(500) == 0
    assert generation(ends.world.seal(Kind.ALIVE, b"")) == 5


def test_counters_go_on_through_a_rekey():
    world, cloud = pair()
    cloud.maintain(0)
    world.open(cloud.seal(Kind.COMMAND, BODY))
    cloud.maintain(REKEY_NS)
    assert world.open(cloud.seal(Kind.COMMAND, BODY))[3] == 1


def test_the_keys_of_two_generations_differ():
    _, cloud = pair()
    first = cloud.seal(Kind.ALIVE, b"")
    cloud.maintain(0)
    cloud.maintain(REKEY_NS)
    cloud._counters[int(Kind.ALIVE)] = 0
    assert cloud.seal(Kind.ALIVE, b"")[16:] != first[16:]


@pytest.mark.parametrize(("sent", "moved"), [(9, 0), (10, 1)])
def test_a_rekey_follows_a_number_of_datagrams(monkeypatch, sent, moved):
    assert session.REKEY_DATAGRAMS == 2**32
    monkeypatch.setattr(session, "REKEY_DATAGRAMS", 10)
    _, cloud = pair()
    for _ in range(sent):
        cloud.seal(Kind.COMMAND, BODY)
    cloud.maintain(1)
    assert generation(cloud.seal(Kind.COMMAND, BODY)) == moved
    for _ in range(8):
        cloud.seal(Kind.COMMAND, BODY)
    cloud.maintain(2)
    assert generation(cloud.seal(Kind.COMMAND, BODY)) == 1  # the count restarts


def test_late_datagrams_of_the_generation_before_are_opened():
    world, cloud = pair()
    cloud.maintain(0)
    late = cloud.seal(Kind.COMMAND, BODY)
    cloud.maintain(REKEY_NS)
    world.open(cloud.seal(Kind.COMMAND, BODY))
    assert world.open(late)[3] == 0


def test_old_generations_are_forgotten():
    world, cloud = pair()
    cloud.maintain(0)
    late = cloud.seal(Kind.COMMAND, BODY)
    for number in range(1, KEPT + 1):
        assert len(world._openers._kept) <= KEPT
        cloud.maintain(number * REKEY_NS)
        world.open(cloud.seal(Kind.COMMAND, BODY))
    with pytest.raises(DecodeError, match=r"^tag$"):
        world.open(late)


@pytest.mark.promise("keys-change-in-flight")
@pytest.mark.parametrize("order", [("world", "cloud"), ("cloud", "world")])
@pytest.mark.parametrize("apart", [0, 1, 90])
def test_a_rotation_loses_no_datagram(order, apart):
    ends = Ends()
    ends.pass_time(50)
    ends.rotate(order[0])
    announced = ends.pass_time(apart)
    assert announced <= apart  # the other end cannot open an announcement
    ends.rotate(order[1])
    assert ends.pass_time(2) <= 1
    assert ends.world._key == ends.cloud._key == NEW
    assert ends.pass_time(700) == 0  # beyond the overlap, and through rekeys


def test_a_rotation_and_a_rekey_at_once():
    ends = Ends()
    ends.pass_time(119)
    ends.rotate("world")
    ends.pass_time(125)
    ends.rotate("cloud")
    ends.pass_time(2)
    assert ends.pass_time(400) == 0
    assert ends.world._key == ends.cloud._key == NEW


def test_an_announced_generation_is_used_for_nothing_else():
    world, cloud = pair()
    world.maintain(0)
    world.ring.replace(KeySet(NEW), 0)
    announced = [world.maintain(second * SECOND_NS) for second in (1, 2)]
    assert [(generation(d), codec.peek(d)[2]) for (d,) in announced] == [(1, 0), (1, 1)]
    (again,) = world.maintain(REKEY_NS)  # the old key gets the generation after the announced one
    assert generation(world.seal(Kind.ALIVE, b"")) == 2
    assert generation(again) == 3
    assert world.next_counter(Kind.ALIVE) == 4
    assert cloud.open(world.seal(Kind.ALIVE, b""))[3] == 4


def test_late_datagrams_are_opened_without_deriving_keys(monkeypatch):
    world, cloud = pair()
    cloud.maintain(0)
    late = cloud.seal(Kind.COMMAND, BODY)
    for number in range(1, KEPT):
        cloud.maintain(number * REKEY_NS)
        world.open(cloud.seal(Kind.COMMAND, BODY))
    monkeypatch.setattr(Session, "_derive", lambda *_: pytest.fail("derives a key again"))
    assert world.open(late)[3] == 0


def test_a_flood_of_forged_generations_derives_each_key_once(monkeypatch):
    world, cloud = pair()
    data = bytearray(cloud.seal(Kind.COMMAND, BODY))
    data[GENERATION] = 5
    derived, derive = [], Session._derive
    monkeypatch.setattr(Session, "_derive", lambda *how: (derived.append(how), derive(*how))[1])
    for _ in range(10):
        with pytest.raises(DecodeError):
            world.open(bytes(data))
    assert len(derived) == 1


@pytest.mark.promise("old-keys-expire")
def test_after_the_overlap_the_old_key_opens_nothing():
    ends = Ends(overlap=10.0)
    ends.rotate("world")
    ends.pass_time(9)
    ends.world.open(ends.cloud.seal(Kind.COMMAND, BODY))
    ends.pass_time(2)
    with pytest.raises(DecodeError, match=r"^tag$"):
        ends.world.open(ends.cloud.seal(Kind.COMMAND, BODY))
    assert ends.world._key == NEW
    assert ends.pass_time(3) == 6


def test_a_second_rotation_replaces_the_first():
    ends = Ends()
    for key in (NEW, Key(b"m" * 32)):
        for end in ("world", "cloud"):
            ends.rotate(end, key)
        ends.pass_time(3)
    assert ends.pass_time(3) == 0
    assert ends.world._key == ends.cloud._key == Key(b"m" * 32)


def test_greetings_with_either_valid_key_are_accepted():
    ends = Ends()
    ends.rotate("world")
    ends.pass_time(1)
    hello = bytes(codec.BODY_SIZES[Kind.HELLO])
    for key in (OLD, NEW):
        ends.world.open(ends.cloud.greet(Kind.HELLO, hello, key))
        assert ends.world.greeting_key == key


def test_an_end_that_had_a_wrong_key_goes_on_with_the_right_one():
    """Its peer has used the right key all the time, and was heard in the meantime."""
    ends = Ends(overlap=2.0)
    ends.rotate("cloud")
    ends.pass_time(3)
    assert not ends.hear_each_other()
    ends.overlap = 300.0
    ends.rotate("cloud", OLD)
    ends.pass_time(1, deliver=False)  # the old one is accepted again
    ends.rotate("cloud", NEW)
    ends.cloud.open(ends.world.seal(Kind.ALIVE, b""))
    ends.rotate("cloud", OLD)
    ends.pass_time(2)
    assert ends.hear_each_other()


def test_a_new_epoch_forgets_the_peers_key():
    ends = Ends()
    for end in ("world", "cloud"):
        ends.rotate(end)
    ends.pass_time(3)
    for end in (ends.world, ends.cloud):
        end.begin(2, key=OLD)
    ends.world.maintain(ends.now_ns)
    assert ends.world._key == OLD
    assert ends.pass_time(3) == 0
    assert ends.world._key == ends.cloud._key == NEW


def test_with_equal_key_files_both_ends_hear_each_other_again():
    for chance in map(random.Random, range(1500)):
        ends = Ends(overlap=chance.choice((2.0, 5.0, 30.0)))
        for _ in range(chance.randint(1, 6)):
            ends.rotate(chance.choice(("world", "cloud")), chance.choice((OLD, NEW, WRONG)))
            if chance.random() < 0.5:
                ends.hear_each_other()  # before either has read its file
            ends.pass_time(chance.choice((0, 0, 1, 2, 3, 7)), deliver=chance.random() < 0.8)
        last = chance.choice((OLD, NEW, Key(b"l" * 32)))
        for end in chance.sample(("world", "cloud"), 2):
            ends.rotate(end, last)
            ends.pass_time(chance.choice((0, 1, 2)))
        ends.pass_time(8)
        assert ends.hear_each_other()
