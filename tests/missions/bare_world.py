"""Both ends around nothing, no robot and no loop: for a million short lives of the session."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from cloudrc.cloud.endpoint import CloudEndpoint, CloudIdentity
from cloudrc.messages import (
    NEVER_NS,
    UPRIGHT,
    ZERO,
    Cause,
    Command,
    GuardState,
    OperatorRequest,
    Request,
    Start,
    Telemetry,
)
from cloudrc.records import Arrival, Fault
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import DecodeError, Direction, Kind
from cloudrc.tunnel.handshake import Knocker
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.tunnel.session import AES_256_GCM, Session, make_session
from cloudrc.world.endpoint import WorldEndpoint, WorldIdentity

MS = 1_000_000
CLOCK = bytes(16)
KEY = Key(b"k" * 32)


def bare_robot() -> SimpleNamespace:
    """A robot that flies whatever the session lets through."""
    guard = SimpleNamespace(
        state=GuardState.TRACK,
        cause=Cause.COMMAND,
        latched=False,
        armed=True,
        counts={},
        changes=[],
        reference=ZERO,
        offer=lambda command, now_ns: None,
    )
    for name in ("forget_commands", "start_mission", "end_mission", "stop", "acknowledge"):
        setattr(guard, name, lambda *given: None)
    simulator = SimpleNamespace(
        tip_force=lambda: 0.0, readings=(ZERO, UPRIGHT, ZERO, ZERO, ZERO * 3), touches=[]
    )
    return SimpleNamespace(
        guard=guard,
        simulator=simulator,
        run=lambda tick_ns, stop_ns: stop_ns,
        put_on_ground=lambda now_ns, cause: None,
    )


def bare_world(
    nonce: bytes = b"w", last_epoch: int = 0, ring: KeyRing | None = None, start_ns: int = 0
) -> WorldEndpoint:
    """World's end, sealed if it gets keys."""
    identity = WorldIdentity(CLOCK, nonce.ljust(16), last_epoch, ring)
    return WorldEndpoint(
        bare_robot(),
        SimpleNamespace(measure=lambda truth: truth),
        identity,
        newest_wins=True,
        command_age_max_ns=250 * MS,
        start_ns=start_ns,
    )


class NoLoop:
    """Stands for cloud's loop: it knows when the robot was seen, and computes nothing."""

    def __init__(self) -> None:
        self.faults: list[Fault] = []
        self.counts: dict[str, int] = {}
        self.reset()

    def reset(self) -> None:
        self.ready, self.basis_stamp_ns = False, NEVER_NS

    def observe(self, telemetry: Telemetry, now_ns: int) -> None:
        self.ready, self.basis_stamp_ns = True, telemetry.stamp_ns


def bare_cloud(nonce: bytes, keys: KeyRing, start_ns: int = 0) -> CloudEndpoint:
    """Cloud's end; what is put into its `teleop.outputs` it sends."""
    teleop = SimpleNamespace(
        outputs=[], outcome=None, settled=True,
        see=lambda seen, now_ns: None, handle_deadline=lambda now_ns: None,
    )  # fmt: skip
    teleop.take_outputs = lambda: [teleop.outputs.pop(0) for _ in teleop.outputs[:]]
    identity = CloudIdentity(CLOCK, nonce.ljust(16), keys)
    loop: Any = NoLoop()
    return CloudEndpoint(loop, teleop, identity, newest_wins=True, start_ns=start_ns)


def ring() -> KeyRing:
    return KeyRing(KeySet(KEY))


class BareCloud:
    """A cloud process that greets and commands when it is told to."""

    def __init__(self, nonce: bytes, keys: KeyRing | None) -> None:
        self.session: Session = make_session(Direction.DOWNLINK, keys)
        self.knocker = Knocker(nonce.ljust(16), CLOCK, AES_256_GCM)
        self.heard: list[str] = []

    def hello(self) -> bytes:
        return self.session.greet(Kind.HELLO, self.knocker.hello())

    def command(self, now_ns: int = 0) -> bytes:
        body = codec.encode_command(Command(now_ns, now_ns, 0, ZERO, 0.0))
        return self.session.seal(Kind.COMMAND, body)

    def start(self, number: int, basis_ns: int = 0) -> bytes:
        """Ask for a mission from the spawn: world opens an epoch."""
        asked = OperatorRequest(number, Request.START, Start.SPAWN, basis_stamp_ns=basis_ns)
        body = codec.encode_operator(asked)
        return self.session.seal(Kind.OPERATOR, body)

    def receive(self, data: bytes) -> bytes | None:
        """Take an answer of world; what is to be sent because of it, if anything."""
        try:
            kind, _, epoch, _, body = self.session.open(data)
        except DecodeError as error:
            self.heard.append(str(error))
            return None
        self.heard.append(Kind(kind).name)
        if kind == Kind.CHALLENGE:
            hello = self.knocker.challenged(codec.decode_challenge(body))
            return hello and self.session.greet(Kind.HELLO, hello)
        if kind == Kind.BUSY:
            self.knocker.refused(codec.decode_busy(body))
        if kind == Kind.ACCEPT:
            accept = codec.decode_accept(body)
            agreement = self.knocker.accepted(epoch, accept, self.session.epoch, asks=True)
            if agreement is not None:
                self.session.begin(epoch, agreement)
        return None


class Bare:
    """One world and some clouds, joined by a link that loses and delays nothing."""

    def __init__(self, keys: KeyRing) -> None:
        self.keys, self.now_ns = keys, 0
        self.world = bare_world(ring=keys)
        self.clouds: dict[str, BareCloud] = {}
        self.sent: list[bytes] = []  # everything that any cloud has ever sent
        self.born = 0

    def cloud(self, name: str) -> BareCloud:
        if name not in self.clouds:
            self.born += 1
            self.clouds[name] = BareCloud(b"%d" % self.born, self.keys)
        return self.clouds[name]

    def send(self, data: bytes | None) -> None:
        """Deliver to world, and every answer to every cloud, until all is quiet."""
        waiting = [data] if data else []
        while waiting:
            one = waiting.pop()
            self.sent.append(one)
            self.world.receive_datagram(one, self.now_ns)
            for answer in self.world.take_datagrams():
                for cloud in self.clouds.values():
                    reply = cloud.receive(answer)
                    if reply:
                        waiting.append(reply)

    def wait(self, ms: float) -> None:
        """Let time pass in world, in steps that are no stall."""
        end_ns = self.now_ns + round(ms * MS)
        while self.now_ns < end_ns:
            self.now_ns = min(self.now_ns + 100 * MS, end_ns)
            self.world.handle_deadline(self.now_ns)
        self.world.take_datagrams()

    def used(self) -> list[tuple[int, int]]:
        """Epoch and counter of the commands that were let through, in that order."""
        records = self.world.take_records()
        return [(r.epoch, r.counter) for r in records if isinstance(r, Arrival) and r.used]

    def outcome(self, data: bytes) -> dict[str, int]:
        """What this datagram is counted under."""
        before = dict(self.world._counts)
        self.world.receive_datagram(data, self.now_ns)
        after = self.world._counts
        return {n: after[n] - before.get(n, 0) for n in after if after[n] != before.get(n, 0)}
