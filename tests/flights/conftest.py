# SPDX-License-Identifier: Apache-2.0

"""Endpoints without robot and loop; flights in virtual time; a world and the test's own cloud."""

from collections import Counter
from functools import lru_cache
from types import SimpleNamespace

from cloudrc.config.load import load_experiment
from cloudrc.flight.assembly.plan import flight_limit
from cloudrc.flight.assembly.world import build_world
from cloudrc.flight.in_memory import fly_in_memory
from cloudrc.flight.virtual.flight import assemble, fly_virtual
from cloudrc.results.record.columns import Recording, RecordStore
from cloudrc.wire.messages import (
    UPRIGHT,
    ZERO,
    Cause,
    Command,
    GuardState,
    Odometry,
    OperatorRequest,
    Request,
    Start,
)
from cloudrc.wire.records import Counted, GuardChange, TelemetrySent
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import DecodeError, Direction, Kind
from cloudrc.wire.tunnel.end import Identity
from cloudrc.wire.tunnel.handshake import ClientHandshake
from cloudrc.wire.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.wire.tunnel.session import Session
from cloudrc.world.endpoint import WorldEndpoint

MS = 1_000_000
CLOCK = bytes(16)
KEY = Key(b"k" * 32)


class Obeying:
    """A part of a robot with some attributes; it takes every other call, and answers None.

    A Mock does the same, but each one is a class of its own: an interleaving would take twice as
    long.
    """

    def __init__(self, **known):
        self.__dict__.update(known)

    def __getattr__(self, name):
        return lambda *words, **named: None


def bare_robot():
    """A robot that flies every accepted command."""
    guard = Obeying(
        state=GuardState.TRACK,
        cause=Cause.COMMAND,
        latched=False,
        armed=True,
        command_age_max_ns=250 * MS,
        counts=Counter(),
        changes=[],
        reference=ZERO,
    )
    truth = lambda now_ns: Odometry(now_ns, ZERO, UPRIGHT, ZERO, ZERO)  # noqa: E731
    simulator = Obeying(truth=truth, touches=[], sensors=(), meter=None)
    run = lambda tick_ns, stop_ns: stop_ns  # noqa: E731
    return Obeying(
        name="pelican", guard=guard, simulator=simulator, observers=[], failure=None, advance=run
    )


def bare_world(ring, nonce=b"w", start_ns=0):
    """Make world's end of the tunnel with a robot that flies every command."""
    return WorldEndpoint(
        bare_robot(),
        SimpleNamespace(exact=False, measure=lambda truth: truth),
        Identity(CLOCK, nonce.ljust(16), ring),
        newest_wins=True,
        start_ns=start_ns,
    )


def ring():
    return KeyRing(KeySet(KEY))


class BareCloud:
    """A cloud process that sends hellos and commands on request."""

    def __init__(self, nonce, keys):
        self.session = Session(Direction.DOWNLINK, keys)
        self.handshake = ClientHandshake(nonce.ljust(16), CLOCK)
        self.heard = []

    def hello(self):
        return self.session.sign(Kind.HELLO, self.handshake.make_hello())

    def command(self, now_ns=0, basis_ns=None, velocity=ZERO):
        basis_ns = now_ns if basis_ns is None else basis_ns
        body = codec.encode_command(Command(now_ns, basis_ns, 0, velocity, 0.0))
        return self.session.seal(Kind.COMMAND, body)

    def ask(self, number, request, start, mission_id=0, basis_ns=0, reached=0, touch=""):
        asked = OperatorRequest(
            number, request, start, mission_id, reached, basis_stamp_ns=basis_ns, touch=touch
        )
        return self.session.seal(Kind.OPERATOR, codec.encode_operator(asked))

    def start(self, number, basis_ns=0):
        """Ask for a mission from the spawn: world opens an epoch."""
        return self.ask(number, Request.START, Start.SPAWN, basis_ns=basis_ns)

    def receive(self, data):
        """Take an answer of world; what is to be sent because of it, if anything."""
        try:
            kind, epoch, _, body = self.session.open(data)
        except DecodeError as error:
            self.heard.append(str(error))
            return None
        self.heard.append(Kind(kind).name)
        if kind == Kind.CHALLENGE:
            hello = self.handshake.answer_challenge(codec.decode(Kind.CHALLENGE, body)[0])
            return hello and self.session.sign(Kind.HELLO, hello)
        if kind == Kind.ACCEPT:
            accept = codec.Accept(*codec.decode(Kind.ACCEPT, body))
            nonces = self.handshake.receive_accept(epoch, accept, asks=True)
            if nonces is not None:
                self.session.begin(epoch, nonces)
        return None


HOVER = load_experiment("hover", ["link.profile=ideal"])


class Bare:
    """A sealed world and some clouds that the test controls; no datagram is lost or late.

    The last cloud that said `hello` is `speaker`: requests and commands come from it.
    """

    def __init__(self, keys, *, flies=False):
        """Start world, with a simulated robot if it `flies`."""
        identity = Identity(CLOCK, b"world".ljust(16), keys)
        self.world = build_world(HOVER, identity) if flies else bare_world(keys)
        self.keys, self.now_ns, self.born = keys, 0, 0
        self.clouds = {}
        self.sent = []  # everything that any cloud has ever sent
        self.records = []

    def cloud(self, name):
        if name not in self.clouds:
            self.born += 1
            self.clouds[name] = BareCloud(b"%d" % self.born, self.keys)
        return self.clouds[name]

    def hello(self, name):
        """Do the handshake as this cloud; return the epoch that it got, 0 if none."""
        self.speaker = self.cloud(name)
        self.send(self.speaker.hello())
        return self.speaker.session.epoch

    def send(self, data):
        """Deliver to world, and every answer to every cloud, until all is quiet."""
        waiting = [data]
        while waiting:
            self.sent.append(waiting.pop())
            self.world.receive_datagram(self.sent[-1], self.now_ns)
            answers = self.world.take_datagrams()
            replies = [cloud.receive(each) for each in answers for cloud in self.clouds.values()]
            waiting += filter(None, replies)

    def wait(self, ms):
        """Let time pass in world; its telemetry is lost."""
        self.now_ns += round(ms * MS)
        while self.world.next_deadline_ns() <= self.now_ns:
            self.world.handle_deadline(self.world.next_deadline_ns())
        self.world.take_datagrams()

    def asked(self, number, request, start, mission_id=0, **more):
        """A request that is passed on now."""
        world_ns = self.now_ns - self.world.slip_ns
        return self.speaker.ask(number, request, start, mission_id, world_ns, **more)

    def request(self, number, request, start, mission_id=0, **more):
        self.send(self.asked(number, request, start, mission_id, **more))

    def command(self, velocity=(0.0, 0.0, 1.0), basis_ns=None):
        return self.speaker.command(self.now_ns, basis_ns, velocity)

    def take(self, kind):
        self.records += self.world.take_records()
        return [record for record in self.records if isinstance(record, kind)]

    @property
    def telemetry(self):
        """The newest telemetry."""
        return self.take(TelemetrySent)[-1].telemetry

    @property
    def change(self):
        """The guard's last change."""
        return self.take(GuardChange)[-1]

    def counts(self):
        self.wait(1000)
        return {record.name: record.total for record in self.take(Counted)}


def talking():
    """A cloud that has a session, and a mission that has been started where the robot stands."""
    talk = Bare(ring(), flies=True)
    talk.hello("cloud")
    talk.wait(20)
    talk.request(1, Request.START, Start.HERE)
    return talk


def fly_on(run, until_ns, over=lambda: False):
    """Fly on; return the new records of world and of cloud."""
    of_world, of_cloud = [], []

    def sink(new_of_world, new_of_cloud):
        of_world.extend(new_of_world)
        of_cloud.extend(new_of_cloud)

    run.fly(over, until_ns, sink)
    return of_world, of_cloud


def records(experiment):
    """Fly and return the records of world and of cloud."""
    _, _, teleop, run = assemble(experiment)
    limit_ns = round(flight_limit(experiment) * 1e9)
    return fly_on(run, limit_ns, lambda: teleop.over)


@lru_cache(maxsize=8)
def fly(name, *settings):
    """Fly and return numbers and verdict; tests of the same flight share it."""
    return fly_in_memory(load_experiment(name, settings))


def sha256(experiment):
    """Fly and return the hash of all records, which is that of a report, too."""
    store = RecordStore()
    fly_virtual(experiment, store.add)
    return Recording(records=store).sha256


def numbers(assessment):
    return {name: number.value for name, number in assessment.numbers.items()}


def both_ways(**keys):
    """Return settings for both directions of the link."""
    return [f"link.both.{key}={value}" for key, value in keys.items()]
