"""Random faults of key files, ends and link: afterwards both ends hear each other again.

Both ends and their driver are the real ones, the robot does nothing: a minute takes 50 ms.
"""

from __future__ import annotations

import random
from functools import partial
from itertools import count
from typing import Any

import pytest

from cloudrc.drivers.virtual import VirtualRun
from cloudrc.faults.models import Clock, RestartableEndpoint
from cloudrc.faults.schedule import Event, Schedule, shaped
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.messages import OperatorRequest, Request, Start
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from tests.conftest import nightly
from tests.flights.conftest import MS, bare_cloud, bare_world

ENDS = ("world", "cloud")
KEYS = [Key(letter * 32) for letter in (b"a", b"b", b"c", b"d")]
CALM, END = 30.0, 45.0
"""When the faults end, except for the last key file, and when the ends are checked [s]."""


class Two:
    """World and cloud with a random schedule of all faults of their session."""

    def __init__(self, seed):
        self.chance = chance = random.Random(seed)
        self.files = dict.fromkeys(ENDS, KeySet(KEYS[0]))
        self.rings: dict[str, KeyRing] = {}
        self.numbers, self.lives = count(1), count(1)
        delay, jitter = chance.choice((0.001, 0.02, 0.15)), chance.choice((0.0, 0.01, 0.1))
        profile = DirectionProfile(delay=delay, jitter=min(jitter, delay))
        kinds = chance.choices(("blackout", "blackout", "loss"), k=chance.randint(0, 4))
        ways = ("up", "down", "both")
        events = (Event(n, *self.when(), chance.random(), chance.choice(ways)) for n in kinds)
        schedule = Schedule(seed, events=tuple(events))
        up, down = (
            LinkDirection(shaped(schedule, profile, way), seed, uplink=way == "up")
            for way in ("up", "down")
        )
        self.world, self.cloud = (
            RestartableEndpoint(partial(self.build, end), Clock()) for end in ENDS
        )
        self.run = VirtualRun(self.world, self.cloud, up, down)
        whatever = (self.rotate, self.leave, self.start)
        for befalls in chance.choices(whatever, k=chance.randint(2, 12)):
            befalls()
        # The last key files are the same, or have a key in common, as after a roll-back.
        common, alike = chance.choice(KEYS), chance.random() < 0.5
        other = chance.choice([key for key in KEYS if key != common])
        files = KeySet(common), KeySet(common, other), KeySet(other, common)
        for end in chance.sample(ENDS, 2):
            keys = files[0] if alike else chance.choice(files)
            self.read(end, CALM + chance.uniform(0.0, 3.0), keys)

    def build(self, end, start_ns):
        ring = self.rings[end] = KeyRing(self.files[end])
        nonce = b"%s %d" % (end.encode(), next(self.lives))
        if end == "world":
            return bare_world(nonce, ring=ring, start_ns=start_ns)
        return bare_cloud(nonce, ring, start_ns)

    def when(self):
        """When something begins, and how long it lasts [s]."""
        return self.chance.uniform(0.2, CALM - 6.0), self.chance.uniform(0.02, 5.0)

    def rotate(self):
        """One end reads another key file, or both do, one after the other."""
        chance, (time, later) = self.chance, self.when()
        current, previous = chance.choice(KEYS[:3]), chance.choice((None, None, *KEYS[:2]))
        ends = chance.sample(ENDS, chance.randint(1, 2))
        for end, at in zip(ends, (time, time + later), strict=False):
            self.read(end, at, KeySet(current, previous))

    def read(self, end, time, keys):
        def read(now_ns):
            self.files[end] = self.rings[end].keys = keys

        getattr(self, end).at(time, read)

    def leave(self):
        """An end restarts or stands still."""
        process, (time, lasts) = getattr(self, self.chance.choice(ENDS)), self.when()
        befalls = self.chance.choice((process.restart, process.freeze))
        process.at(time, lambda now_ns: befalls(now_ns, lasts))

    def start(self):
        """A mission starts from the spawn: world moves on to the next epoch."""

        def ask(now_ns):
            if self.cloud.inner is not None:
                request = OperatorRequest(next(self.numbers), Request.START, Start.SPAWN)
                self.cloud.inner.teleop.outputs.append(request)  # type: ignore[attr-defined]

        self.cloud.at(self.when()[0], ask)

    def hear_each_other(self):
        self.run.fly(lambda: False, round(END * 1e9), lambda of_world, of_cloud: None)
        world: Any = self.world.inner
        cloud: Any = self.cloud.inner
        if world._session.epoch != cloud._session.epoch:
            return False
        heard_ns = self.run.now_ns - cloud._heard_ns
        silent_ns = self.run.now_ns - world._door._fresh_until_ns  # beyond the age limit
        return silent_ns < 300 * MS and heard_ns < 500 * MS


@pytest.mark.parametrize("first", [0, *nightly(1_000)])
def test_after_the_rotations_both_ends_hear_each_other(first):
    for seed in range(first, 4 * first or 40):
        assert Two(seed).hear_each_other(), f"seed {seed}"
