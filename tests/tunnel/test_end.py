"""The common part of both ends, at world's."""

from cloudrc.records import SessionOpened
from cloudrc.tunnel.codec import Kind, peek
from tests.flights.conftest import Bare, ring


def test_an_end_gives_its_datagrams_and_records_once():
    bare = Bare(ring())
    world = bare.world
    bare.send(bare.cloud("a").hello())
    assert (world.sealed, world.epoch) == (True, 1)
    assert any(isinstance(record, SessionOpened) for record in world.take_records())
    assert world.take_records() == []
    world.handle_deadline(world.next_deadline_ns())
    assert peek(world.take_datagrams()[-1])[:2] == (Kind.TELEMETRY, 1)
    assert world.take_datagrams() == []
    assert world.counts["sent"] == 3, "a challenge, an acceptance, telemetry"
