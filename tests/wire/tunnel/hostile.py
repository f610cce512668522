# SPDX-License-Identifier: Apache-2.0

"""Send hostile datagrams to both ends, and check that none is accepted, raises or is kept.

As a program, this module is a coverage-guided fuzzer with libFuzzer's flags:

    python tests/wire/tunnel/hostile.py -atheris_runs=10000000 [CORPUS]

There are four kinds of hostile datagrams: random bytes; a datagram of the session with some bytes
changed; a datagram cut short or made longer; and a datagram sealed with another key. From time to
time the clock advances, and both ends get each other's datagrams or only captured ones.
"""

import atexit
import resource
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[3]))  # it is a program, too

from cloudrc.flight.assembly.cloud import build_cloud
from cloudrc.flight.virtual.flight import start_mission
from cloudrc.wire.records import Fault
from cloudrc.wire.tunnel import codec
from cloudrc.wire.tunnel.codec import Kind
from cloudrc.wire.tunnel.end import Identity
from tests.flights.conftest import CLOCK, HOVER, MS, bare_world, ring
from tests.wire.tunnel.conftest import pair

STEPS_NS = tuple(round(ms * MS) for ms in (1, 30, 400, 1_500, 6_000, 150_000))
"""Steps of time [ns]; cloud asks for a session after 0.5 s of silence."""
TOLD_MAX = 256
"""Largest number of faults of a cloud without a session: one per version, one for the key."""
DOWNLINK = (Kind.COMMAND, Kind.OPERATOR, Kind.ALIVE)


class Target:
    """A world and a cloud in a session, with all datagrams that were valid between them."""

    def __init__(self, pace=5_000):
        """Begin a session; time passes after every `pace` datagrams."""
        self.pace, self.now_ns = pace, 0
        self.world = bare_world(ring())
        self.cloud = build_cloud(HOVER, Identity(CLOCK, b"c" * 16, ring()), start_mission(HOVER))
        self.frames: list[bytes] = []
        for _ in range(40):  # until both are in one session
            self.cloud.handle_deadline(self.cloud.next_deadline_ns())
            for source, target in ((self.cloud, self.world), (self.world, self.cloud)):
                datagrams = source.take_datagrams()
                self.frames += datagrams
                self.give(datagrams, target)
        assert self.cloud._session.epoch == self.world._session.epoch == 1
        self.captured = tuple(self.frames)
        self.frames.append(self.world._session.sign(Kind.BUSY, codec.encode(Kind.BUSY, b"c" * 16)))
        ends = dict.fromkeys(DOWNLINK, self.cloud) | {Kind.TELEMETRY: self.world}
        for kind, end in ends.items():
            self.frames.append(end._session.seal(kind, bytes(codec.BODY_SIZES[kind])))
        self.known, self.first = frozenset(self.frames), tuple(self.frames)
        self.strangers = pair(1, b"s" * 32)
        self.drain()
        self.before = self.state()
        self.tried = self.asked = self.told = 0

    def drain(self):
        for end in (self.world, self.cloud):
            end.take_records()
            end.take_datagrams()

    def give(self, datagrams, end):
        for data in datagrams:
            end.receive_datagram(data, self.now_ns)

    def state(self):
        """Return all state that an accepted datagram would change."""
        accepted = "used late repeated stale hello busy accept_ignored unanswered".split()
        ends = (self.world, self.cloud)
        return (
            [[end.counts[name] for name in accepted] for end in ends],
            [end._session.epoch for end in ends],
            *(self.world._door._fresh_until_ns, self.cloud._heard_ns),
            *(self.world._number, self.world._waiting),
        )

    def try_one(self, program):
        """Make a hostile datagram from a fuzzer's bytes and give it to both ends."""
        data = self.make(program)
        if data in self.known:
            return
        self.tried += 1
        self.world.receive_datagram(data, self.now_ns)
        self.cloud.receive_datagram(data, self.now_ns)
        if self.tried % 1000 == 0 or self.tried % self.pace == 0:
            self.check()
        if self.tried % self.pace == 0:
            self.pass_time(int.from_bytes(program[-2:], "little"))
            self.before = self.state()

    def pass_time(self, choice):
        """Advance time; both ends then get each other's datagrams or captured ones."""
        self.asked = 0
        step, heard = divmod(choice, 2)
        self.now_ns += STEPS_NS[step % len(STEPS_NS)]
        said = self.due(self.world)
        if heard:
            self.give(said, self.cloud)
        answers = self.due(self.cloud)
        if heard:
            self.give(answers, self.world)
            self.frames = [*self.first, *said[-1:], *answers[-1:]]
            self.known = frozenset(self.frames)
        else:
            before = self.state()[1:]
            self.give(self.captured, self.world)
            self.give(self.captured, self.cloud)
            assert self.state()[1:] == before, "what was captured was let through again"
        self.drain()

    def due(self, end):
        """Return the datagrams that an end sends now."""
        end.handle_deadline(self.now_ns)
        return end.take_datagrams()

    def check(self):
        assert self.state() == self.before, "a hostile datagram was let through"
        assert self.world.take_datagrams() == self.world.take_records() == []
        asked = [codec.peek(data)[0] for data in self.cloud.take_datagrams()]
        self.asked += len(asked)
        # Cloud may assume a new epoch: it sends one hello in 100 ms, the first of which is gone.
        assert self.asked <= (self.now_ns > 0), "more hellos than are due"
        assert set(asked) <= {Kind.HELLO}
        told = self.cloud.take_records()
        self.told += len(told)
        assert not told or self.cloud._wants_session(self.now_ns), "a session has no faults"
        assert self.told <= TOLD_MAX, "the user is told the same again"
        assert all(isinstance(one, Fault) and one.code in ("version", "key") for one in told)

    def make(self, program):
        if len(program) < 4:
            return program
        way, which, rest = program[0] % 4, program[1] | program[2] << 8, program[3:]
        frame = self.frames[which % len(self.frames)]
        if way == 0:
            return rest[:2048]
        if way == 1:
            spoiled = bytearray(frame)
            for at, change in zip(rest[::2], rest[1::2], strict=False):
                spoiled[at % len(spoiled)] ^= change
            return bytes(spoiled)
        if way == 2:
            length = (rest[0] | which & 0x700) % 2048
            return (frame + rest * (1 + length // len(rest)))[:length]
        kind = DOWNLINK[which % 3] if which & 1 else Kind.TELEMETRY
        size = codec.BODY_SIZES[kind]
        session = self.strangers[kind != Kind.TELEMETRY]
        return session.seal(kind, (rest * (1 + size // len(rest)))[:size])


def memory():
    """Return this process's present memory on Linux [MiB]; the peak could hide a leak."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def main():
    import atheris

    with atheris.instrument_imports(include=["cloudrc.wire.tunnel", "cloudrc.world.endpoint",
                                             "cloudrc.cloud.endpoint"]):  # fmt: skip
        for name in [name for name in sys.modules if name.startswith(("cloudrc.", "tests."))]:
            del sys.modules[name]
        from tests.wire.tunnel import hostile

    target = hostile.Target()
    begin: list[float] = []

    def one(data):
        target.try_one(data)
        if target.tried == 100_000 and not begin:
            begin.append(memory())

    @atexit.register
    def report():
        target.check()
        grown = memory() - begin[0] if begin else 0.0
        print(f"hostile {target.tried} accepted 0 memory {grown:+.1f} MiB", flush=True)

    atheris.Setup(sys.argv, one)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
