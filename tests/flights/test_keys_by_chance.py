"""Random faults of key files, ends and link: afterwards both ends hear each other again.

Both ends and their driver are the real ones, the robot does nothing: a minute takes 50 ms.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from itertools import count
from typing import Any

import pytest

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.drivers.virtual import VirtualRun
from cloudrc.faults.models import Clock, RestartableEndpoint
from cloudrc.faults.schedule import Event, Schedule, shaped
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.messages import OperatorRequest, Request, Start
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from tests.flights.conftest import MS, bare_cloud, bare_world

ENDS = ("world", "cloud")
KEYS = [Key(letter * 32) for letter in (b"a", b"b", b"c", b"d")]
CALM, END = 30.0, 45.0
"""When the faults end, except for the last key file, and when the ends are checked [s]."""


class Two:
    """World and cloud with a random schedule of all faults of their session."""

    def __init__(self, seed: int) -> None:
        self.chance = chance = random.Random(seed)
        self.said: list[tuple[Any, ...]] = []
        self.files = dict.fromkeys(ENDS, KeySet(KEYS[0]))
        self.rings: dict[str, KeyRing] = {}
        self.numbers, self.lives = count(1), count(1)
        delay, jitter = chance.choice((0.001, 0.02, 0.15)), chance.choice((0.0, 0.01, 0.1))
        profile = DirectionProfile(delay=delay, jitter=min(jitter, delay))
        schedule = Schedule(seed, events=self.link_events())
        up, down = (shaped(schedule, profile, way) for way in ("up", "down"))
        self.world = RestartableEndpoint(self.build_world, Clock())
        self.cloud = RestartableEndpoint(self.build_cloud, Clock(), "cloud")
        links = LinkDirection(up, seed, uplink=True), LinkDirection(down, seed, uplink=False)
        self.run = VirtualRun(self.world, self.cloud, *links)
        whatever = (self.rotate, self.rotate, self.kill, self.pause, self.start, self.start)
        for befalls in chance.choices(whatever, k=chance.randint(2, 12)):
            befalls()
        self.end_with_key_files()

    def build_world(self, start_ns: int) -> Any:
        ring = self.rings["world"] = KeyRing(self.files["world"])
        return bare_world(b"world %d" % next(self.lives), ring=ring, start_ns=start_ns)

    def build_cloud(self, start_ns: int) -> CloudEndpoint:
        ring = self.rings["cloud"] = KeyRing(self.files["cloud"])
        return bare_cloud(b"cloud %d" % next(self.lives), ring, start_ns)

    def link_events(self) -> tuple[Event, ...]:
        chance, events = self.chance, []
        for kind in chance.choices(("blackout", "blackout", "loss"), k=chance.randint(0, 4)):
            at, lasts = self.when()
            way = chance.choice(("up", "down", "both"))
            events.append(Event(kind, at, lasts, chance.random(), way))
        return tuple(events)

    def when(self) -> tuple[float, float]:
        """When something begins, and how long it lasts [s]."""
        return self.chance.uniform(0.2, CALM - 6.0), self.chance.uniform(0.02, 5.0)

    def at(self, end: str, time: float, what: Callable[[int], None], *words: Any) -> None:
        getattr(self, end).at(time, what)
        self.said.append((round(time, 3), end, *words))

    def rotate(self) -> None:
        """One end reads another key file, or both do, one after the other."""
        chance, (time, later) = self.chance, self.when()
        current, previous = chance.choice(KEYS[:3]), chance.choice((None, None, *KEYS[:2]))
        keys = KeySet(current, previous)
        first, second = chance.sample(ENDS, 2)
        self.read(first, time, keys)
        if chance.random() < 0.5:
            self.read(second, time + later, keys)

    def read(self, end: str, time: float, keys: KeySet) -> None:
        def read(now_ns: int) -> None:
            self.files[end] = self.rings[end].keys = keys

        self.at(end, time, read, "reads", keys)

    def kill(self) -> None:
        end, (time, lasts) = self.chance.choice(ENDS), self.when()
        mortal: Any = getattr(self, end)
        self.at(end, time, mortal.kill, "is killed")
        self.at(end, time + lasts, mortal.start, "starts")

    def pause(self) -> None:
        end, (time, lasts) = self.chance.choice(ENDS), self.when()
        mortal: RestartableEndpoint = getattr(self, end)
        self.at(end, time, lambda now_ns: mortal.freeze(now_ns, lasts), "stands still", lasts)

    def start(self) -> None:
        """A mission starts from the spawn: world moves on to the next epoch."""

        def ask(now_ns: int) -> None:
            if isinstance(cloud := self.cloud.inner, CloudEndpoint):
                request = OperatorRequest(next(self.numbers), Request.START, Start.SPAWN)
                cloud.teleop.outputs.append(request)

        self.at("cloud", self.when()[0], ask, "asks for a start")

    def end_with_key_files(self) -> None:
        """The same for both, or different ones with a key in common, as after a roll-back."""
        chance, common = self.chance, self.chance.choice(KEYS)
        one = KeySet(common)
        alike = chance.random() < 0.5
        for end in chance.sample(ENDS, 2):
            keys = one if alike else self.with_key(common)
            self.read(end, CALM + chance.uniform(0.0, 3.0), keys)

    def with_key(self, common: Key) -> KeySet:
        other = self.chance.choice([key for key in KEYS if key != common])
        files = KeySet(common), KeySet(common, other), KeySet(other, common)
        return self.chance.choice(files)

    def hear_each_other(self) -> bool:
        self.run.fly(lambda: False, round(END * 1e9), lambda of_world, of_cloud: None)
        world: Any = self.world.inner
        cloud: Any = self.cloud.inner
        if world._session.epoch != cloud._session.epoch:
            return False
        heard_ns = self.run.now_ns - cloud._heard_ns
        silent_ns = self.run.now_ns - world._door._fresh_until_ns  # beyond the age limit
        return silent_ns < 300 * MS and heard_ns < 500 * MS


@pytest.mark.parametrize("first", [0, pytest.param(1_000, marks=pytest.mark.full)])
def test_after_the_rotations_both_ends_hear_each_other(first: int) -> None:
    for seed in range(first, 4 * first or 40):
        two = Two(seed)
        hear, said = two.hear_each_other(), sorted(two.said, key=lambda each: each[:2])
        assert hear, f"seed {seed}: {said}"
