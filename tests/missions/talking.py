"""A world, and a cloud of which a test writes every datagram itself."""

from __future__ import annotations

from cloudrc import assembly
from cloudrc.config.load import load_experiment
from cloudrc.messages import Command, OperatorRequest, Request, Start
from cloudrc.records import Counted
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import DecodeError, Direction, Kind
from cloudrc.tunnel.handshake import Knocker
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import AES_256_GCM, Session
from cloudrc.world.endpoint import WorldIdentity

MS = 1_000_000
CLOCK = b"one clock for all"[:16]
KEY = Key(b"k" * 32)
HOVER = load_experiment("hover", ["link.profile=ideal"])


class Talk:
    """A sealed world; the cloud is what the test says."""

    def __init__(self, last_epoch: int = 0, nonce: bytes = b"world", key: Key = KEY) -> None:
        ring = KeyRing(KeySet(KEY))
        identity = WorldIdentity(CLOCK, nonce.ljust(16), last_epoch, ring)
        self.world = assembly.build_world(HOVER, identity)
        self.key, self.now_ns, self.records = key, 0, []
        self.clouds: dict[bytes, tuple[Session, Knocker]] = {}
        self.session = self.cloud(b"cloud")[0]

    def cloud(self, nonce: bytes) -> tuple[Session, Knocker]:
        """The cloud process of this name; from here on the one that speaks."""
        if nonce not in self.clouds:
            session = Session(Direction.DOWNLINK, KeyRing(KeySet(self.key)))
            self.clouds[nonce] = session, Knocker(nonce.ljust(16), CLOCK, AES_256_GCM)
        self.session = self.clouds[nonce][0]
        return self.clouds[nonce]

    def wait(self, until_ns: int) -> None:
        while self.world.next_deadline_ns() <= until_ns:
            self.world.handle_deadline(self.world.next_deadline_ns())
        self.now_ns = until_ns

    def send(self, data: bytes) -> None:
        self.world.receive_datagram(data, self.now_ns)

    def hear(self, *kinds: Kind) -> list[tuple[int, int, bytes]]:
        """Kind, epoch and body of what world has answered; all else is dropped."""
        heard = []
        for data in self.world.take_datagrams():
            try:
                kind, _, epoch, _, body = self.session.open(data)
            except DecodeError:
                continue
            if kind in kinds:
                heard.append((kind, epoch, body))
        return heard

    def hello(self, nonce: bytes) -> int:
        """Greet as this cloud, up to world's answer; the epoch that it got, 0 if none."""
        session, knocker = self.cloud(nonce)
        self.send(session.greet(Kind.HELLO, knocker.hello()))
        answers = self.hear(Kind.CHALLENGE, Kind.ACCEPT)
        for kind, _, body in answers:
            if kind == Kind.CHALLENGE:
                self.send(
                    session.greet(Kind.HELLO, knocker.challenged(codec.decode_challenge(body)))
                )
                answers = self.hear(Kind.ACCEPT)
        for _, epoch, body in answers:
            accept = codec.decode_accept(body)
            agreement = knocker.accepted(epoch, accept, session.epoch, asks=True)
            if agreement is not None:
                session.begin(epoch, agreement)
            return epoch
        return 0

    def request(self, number: int, request: Request, start: Start, mission_id: int = 0) -> None:
        self.send(self.asked(number, request, start, mission_id))

    def asked(self, number: int, request: Request, start: Start, mission_id: int = 0) -> bytes:
        """A request that is passed on now."""
        told = OperatorRequest(number, request, start, mission_id, basis_stamp_ns=self.world_ns)
        return self.session.seal(Kind.OPERATOR, codec.encode_operator(told))

    @property
    def world_ns(self) -> int:
        """World's clock."""
        return self.now_ns - self.world.slip_ns

    def command(self, velocity=(0.0, 0.0, 1.0), basis_ns=None) -> bytes:
        basis_ns = self.now_ns if basis_ns is None else basis_ns
        command = Command(self.now_ns, basis_ns, 0, velocity, 0.0)
        return self.session.seal(Kind.COMMAND, codec.encode_command(command))

    def take(self, kind: type) -> list:
        self.records += self.world.take_records()
        return [record for record in self.records if isinstance(record, kind)]

    def counts(self) -> dict[str, int]:
        self.wait(self.now_ns + 1000 * MS)
        return {record.name: record.total for record in self.take(Counted)}


def talking() -> Talk:
    """A cloud that has a session, and a mission that has been started where the robot stands."""
    talk = Talk()
    talk.hello(b"cloud")
    talk.wait(20 * MS)
    talk.request(1, Request.START, Start.HERE)
    return talk
