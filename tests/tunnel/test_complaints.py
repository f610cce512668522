"""Why two ends have no session is logged once, and only while they have none."""

import pytest

from cloudrc.records import Fault
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Kind
from cloudrc.tunnel.handshake import KEY_TEXT, HandshakeLog
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from tests.flights.conftest import Bare, BareCloud, ring

OTHER = KeyRing(KeySet(Key(b"x" * 32)))


def faults(bare):
    return [record for record in bare.world.take_records() if isinstance(record, Fault)]


def test_another_version_is_logged_once():
    bare = Bare(ring())
    hello = bytes([6]) + bare.cloud("a").hello()[1:]
    for _ in range(3):
        bare.world.receive_datagram(hello, 0)
    (fault,) = faults(bare)
    assert fault.code == "version"
    assert fault.text.startswith("peer speaks v6, we speak v5: ")
    assert bare.world._counts["version"] == 3


def test_another_key_is_logged_once():
    bare = Bare(ring())
    for _ in range(3):
        bare.world.receive_datagram(BareCloud(b"a", OTHER).hello(), 0)
    (fault,) = faults(bare)
    assert (fault.code, "same key file" in fault.text) == ("key", True)
    assert bare.world.take_datagrams() == []


def test_within_a_session_garbage_is_only_counted():
    bare = Bare(ring())
    bare.send(bare.cloud("a").hello())
    bare.world.receive_datagram(BareCloud(b"b", OTHER).hello(), 0)
    assert faults(bare) == []
    assert bare.world._counts["tag"] == 1


@pytest.mark.parametrize("outcome", ["malformed", "direction", "old_epoch"])
def test_garbage_is_not_logged(outcome):
    assert HandshakeLog().about(outcome, bytes(16), 0) == []


@pytest.mark.parametrize("kind", Kind)
def test_only_a_wrong_tag_of_a_greeting_is_logged(kind):
    data = codec.encode_header(kind, 1, 1, 1)
    said = [Fault(7, "key", KEY_TEXT)] if kind <= Kind.BUSY else []
    assert HandshakeLog().about("tag", data, 7) == said


def test_a_version_fault_names_both_versions():
    complaints = HandshakeLog()
    text = "peer speaks v9, we speak v5: run the same version of cloudrc at both ends"
    assert complaints.about("version", bytes([9, 1, 2]), 7) == [Fault(7, "version", text)]
    assert complaints.about("version", bytes([9, 1, 2]), 8) == []


def test_garbage_does_not_hide_the_peers_version():
    complaints = HandshakeLog()
    assert len(complaints.about("version", bytes(16), 7)) == 1
    (fault,) = complaints.about("version", bytes([4]) + bytes(15), 8)
    assert fault.text.startswith("peer speaks v4, ")


def test_after_a_session_the_fault_is_logged_again():
    complaints = HandshakeLog()
    assert complaints.say("x", "text", 7) == [Fault(7, "x", "text")]
    assert complaints.say("x", "text", 8) == []
    complaints.forget()
    assert complaints.say("x", "text", 9) == [Fault(9, "x", "text")]
