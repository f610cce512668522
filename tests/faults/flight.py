# SPDX-License-Identifier: Apache-2.0

"""Fly an experiment in virtual time with faults, and check the invariants after every step.

World, cloud and their driver are those of production; processes and teleop are models.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TypeVar

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.cloud.loop import ControlLoop
from cloudrc.cloud.operator import Operator
from cloudrc.config import shipped
from cloudrc.config.load import load_experiment
from cloudrc.config.robot import find_robot
from cloudrc.config.schema import World
from cloudrc.flight.assembly.cloud import build_cloud
from cloudrc.flight.assembly.plan import build_plan
from cloudrc.flight.assembly.world import build_world
from cloudrc.flight.pod.teleop_link import PERIOD_NS as WAKE_NS
from cloudrc.flight.virtual.flight import CLOUD_CLOCK, VIRTUAL_CLOCK
from cloudrc.flight.virtual.run import Clock, VirtualRun
from cloudrc.link.model import LinkDirection
from cloudrc.link.traces import link_profile
from cloudrc.results.record.columns import Recording
from cloudrc.teleop.mission import Teleop
from cloudrc.teleop.store import MissionRecord, Order
from cloudrc.wire.endpoint import Endpoint
from cloudrc.wire.messages import GuardState
from cloudrc.wire.records import Counted, GuardChange, MissionEvent, Record
from cloudrc.wire.tunnel.end import Identity
from cloudrc.wire.tunnel.keys import KeyRing, KeySet
from cloudrc.world.endpoint import WorldEndpoint
from cloudrc.world.robot import Robot
from tests.faults.adversary import DishonestLoop, HostileOperator, Lie, dishonesty
from tests.faults.inject import BUGS, SECRET, bugs, inject, shaped
from tests.faults.invariants import FlightSteps, check_order
from tests.faults.models import FaultyEndpoint, TeleopModel, TwoClouds
from tests.faults.observer import RobotObserver
from tests.faults.rules import Breach, Rules
from tests.faults.schedule import OFFSET_MAX, Schedule, generator

_Kind = TypeVar("_Kind")


class FaultRun:
    """One flight of world, cloud, teleop and link.

    `secrets` maps "world" and "cloud" to the keys in their key files; `rings` maps them to the keys
    that their running processes use. `others` are the records of a second cloud.
    """

    def __init__(
        self,
        schedule: Schedule,  # faults of the flight, and the link's profile
        *settings: str,  # settings of the robot's experiment, as for `--set`
        start: bool = True,  # whether the experiment's mission is ordered at once
        life: int = 1,  # makes the nonces differ from those of another flight
        lies: Sequence[Lie] = (),  # change cloud's commands after those of the schedule
    ) -> None:
        """Prepare a flight; comments in the signature describe the arguments.

        Raises:
            ValueError: If the schedule names an unknown policy of a dishonest cloud, or if its
                faults do not fit the link's profile.
        """
        self.schedule = schedule
        plans = ["guard.plan_max_s=0.8"] if "plans" in schedule.policy else []
        faults = f"link.profile={schedule.profile}", f"guard.hold_max_s={schedule.hold_max:g}"
        robot = shipped.model_path("robot", schedule.robot, Path())
        settings = (f"world.robot={robot}", *plans, *faults, *settings, f"seed={schedule.seed}")
        self.experiment = load_experiment(_experiment_of(robot), list(settings))
        offset = schedule.cloud_offset % OFFSET_MAX  # no clock shows a negative time
        self._clock = Clock(round(offset * 1e9), schedule.cloud_drift)
        is_shared = self._clock == Clock()
        self._clock_id = VIRTUAL_CLOCK if is_shared else CLOUD_CLOCK
        self._fence = self.experiment.world.files.fence
        policy, self._words = dishonesty(schedule, self._fence)
        mistakes = [bugs(schedule, self._clock)] if schedule.of(*BUGS) else []
        self._lies = [*policy, *mistakes, *lies]
        self._rules = Rules(self.experiment)
        self._life, self._observers = life, list[RobotObserver]()
        self._rival_at = min((event.at for event in schedule.of("second_cloud")), default=None)
        self.secrets, self.rings = {"world": SECRET, "cloud": SECRET}, dict[str, KeyRing]()
        self.generations = {"world": 0, "cloud": 0}
        self.of_world, self.of_cloud = list[Record](), list[Record]()
        self.others = list[Record]()
        phase_ns = int(generator(self.experiment.seed, 45).integers(WAKE_NS))
        self.teleop = TeleopModel(self._fence, phase_ns)
        if start:
            self.teleop.order(self.make_order(), self._clock.at(0))
        self.world = FaultyEndpoint(self._build_world, Clock())
        self.cloud = FaultyEndpoint(self._build_cloud, self._clock)
        self.teleop.run_on(self.cloud)
        self._connect()
        inject(self)

    def _connect(self) -> None:
        """Put the links between world and cloud."""
        schedule, seed = self.schedule, self.experiment.seed
        ends = {"up": self.experiment.uplink, "down": self.experiment.downlink}
        self.uplink, self.downlink = (
            LinkDirection(shaped(schedule, link_profile(end), way), seed, way == "up")
            for way, end in ends.items()
        )
        self.run = VirtualRun(self.world, self.cloud, self.uplink, self.downlink)

    @property
    def robot(self) -> Robot:
        """The robot of the running world process."""
        assert isinstance(self.world.inner, WorldEndpoint), "the world is down"
        return self.world.inner.robot

    @property
    def mission(self) -> MissionRecord:
        """The mission that was ordered last."""
        return self.teleop.missions[-1]

    @property
    def now(self) -> float:
        """Virtual time [s]."""
        return self.run.now_ns * 1e-9

    def make_order(self) -> Order:
        """Make the order with which teleop flies the experiment's mission."""
        plan = build_plan(self.experiment)
        return Order(plan, touch=self.experiment.mission.touch)

    def fly(self, until: float, look: Callable[[], bool | None] = lambda: False) -> FaultRun:
        """Fly on until the virtual time `until` [s], or until `look()` is True; return self.

        `look` is called every 100 ms.
        """
        self.run.fly(lambda: bool(look()), round(until * 1e9), self._sink)
        return self

    def fly_mission(self, limit: float = 120.0) -> FaultRun:
        """Fly until the mission's end or the virtual time `limit` [s], then fly 1 s more."""
        self.fly(limit, lambda: self.teleop.service is not None and self.mission.ended)
        return self.fly(self.now + 1.0)

    def replace_key(self, end: str, keys: KeySet) -> None:
        """Replace the keys of `end` (world or cloud), in its key file and its running process."""
        self.secrets[end] = self.rings[end].keys = keys

    def end_rival(self) -> None:
        """Stop the second cloud, so that the first cloud can control the robot again."""
        self.end_cloud(1)
        self._rival_at = None

    def end_cloud(self, number: int) -> None:
        """Stop the first cloud (0) or the second one (1), if both run."""
        if isinstance(self.cloud.inner, TwoClouds):
            del self.cloud.inner.members[number : number + 1]

    def sha256(self) -> str:
        """Return the hash of all records so far."""
        return Recording.from_records(self.of_world, self.of_cloud).sha256

    def steps(self) -> list[FlightSteps]:
        """Return the steps of the robot so far, in a list for each process of world."""
        return [FlightSteps(each) for each in self._observers]

    def breaches(self) -> list[Breach]:
        """Return the breaches of invariants so far, in the order of time."""
        starts_ns = [each.start_ns for each in self._observers]
        found = [each.breaches() for each in self.steps()]
        return sorted(chain(check_order(self.of_world, starts_ns), *found))

    @property
    def changes(self) -> list[GuardChange]:
        """The changes of the guard's state so far."""
        return self.of(GuardChange)

    def of(self, kind: type[_Kind]) -> list[_Kind]:
        """Return world's records of a class."""
        return [record for record in self.of_world if isinstance(record, kind)]

    def count(self, name: str) -> int:
        """Return the last value of world's counter `name` [1]; 0 if it was never recorded."""
        return next((one.total for one in reversed(self.of(Counted)) if one.name == name), 0)

    def events(self, name: str) -> list[MissionEvent]:
        """Return the mission events with this name."""
        return [event for event in self.teleop.events if event.event == name]

    def guard_now(self) -> tuple[GuardState, str]:
        """Return the guard's present state and its cause; GROUND while world is not running.

        The records are not enough: a restarted world begins in GROUND, and makes no record of it.
        """
        if self.world.inner is None:
            return GuardState.GROUND, "the world is down"
        return self.robot.guard.state, self.robot.guard.cause.words

    def _build_world(self, start_ns: int) -> Endpoint:
        identity = self._begin("world", VIRTUAL_CLOCK)
        world = build_world(self.experiment, identity, lambda: start_ns)
        self._observers.append(RobotObserver(world.robot, self._rules, start_ns))
        return world

    def _build_cloud(self, start_ns: int) -> Endpoint:
        identity = self._begin("cloud", self._clock_id)
        teleop: Operator = self.teleop.join(start_ns)
        if self._words is not None:
            teleop = HostileOperator(teleop, self._words)
        make_loop = partial(DishonestLoop, self._lies) if self._lies else ControlLoop
        cloud = build_cloud(
            self.experiment, identity, teleop, lambda: start_ns, make_loop=make_loop
        )
        if self._rival_at is None:
            return cloud
        joins_ns = max(self._clock.at(round(self._rival_at * 1e9)), start_ns)
        return TwoClouds([cloud, self._build_rival(joins_ns)], self.others)

    def _build_rival(self, start_ns: int) -> CloudEndpoint:
        """Build a second cloud with the same key; it has its own teleop and the same mission."""
        teleop = Teleop(self._fence)
        teleop.start(start_ns, MissionRecord("rival", self.make_order(), 0))
        identity = Identity(VIRTUAL_CLOCK, b"rival".ljust(16), KeyRing(SECRET))
        return build_cloud(self.experiment, identity, teleop, lambda: start_ns)

    def _begin(self, end: str, clock_id: bytes) -> Identity:
        """Make key ring and identity of a new process of `end`, "world" or "cloud"."""
        self.generations[end] += 1
        self.rings[end] = KeyRing(self.secrets[end])
        nonce = f"{end}-{self._life}-{self.generations[end]}".encode().ljust(16)
        return Identity(clock_id, nonce, self.rings[end])

    def _sink(self, of_world: list[Record], of_cloud: list[Record]) -> None:
        self.of_world += of_world
        self.of_cloud += of_cloud


def _experiment_of(robot: str) -> str:
    """Return the name of the shipped experiment in which a robot meets faults."""
    if robot == World().robot:
        return "paper"
    return "pillars" if find_robot(robot).planar else "steps"
