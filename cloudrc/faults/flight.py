"""A flight in virtual time in which everything can break, and everything is looked at.

Both ends are those of production, driven by the driver of production; around them lies what a
scenario needs: ends that die and return, an operator's desk with a journal, a watch over the
invariants, and questions about what happened.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Unpack

from cloudrc import assembly
from cloudrc.cloud.endpoint import CloudEndpoint, CloudIdentity
from cloudrc.config.load import ResolvedExperiment, load_experiment
from cloudrc.drivers.virtual import VirtualRun
from cloudrc.endpoint import Endpoint
from cloudrc.faults import states
from cloudrc.faults.crowd import Crowd
from cloudrc.faults.desk import Desk
from cloudrc.faults.desk_apart import apart
from cloudrc.faults.mortal import Clock, Mortal
from cloudrc.faults.options import SECRET, Options, Shape
from cloudrc.faults.walls import Wall
from cloudrc.faults.watch import Watch
from cloudrc.link.model import LinkDirection
from cloudrc.messages import GuardState
from cloudrc.record.hash import RecordHash
from cloudrc.records import Contact, Counted, GroundTruth, GuardChange, MissionEvent, Record
from cloudrc.teleop.store import Mission, Order
from cloudrc.tunnel.keys import KeyRing, KeySet
from cloudrc.world.endpoint import WorldEndpoint, WorldIdentity

SHARED = b"one clock for all"[:16]
OTHER = b"another clock..."


class Flight:
    """World, cloud, desk and link, from take-off on.

    Attributes:
        honest: Whether a contact is the cloud's failure.
        world: That end.
        cloud: That end.
        desk: Teleop.
        watch: What it has found.
        of_world: World's records, if they are kept.
        of_cloud: Cloud's records, likewise.
        changes: Of the guard.
        generations: How many processes there have been of each end.
        rings: The keys of the processes that live, by end.
        secrets: What their key files hold, by end.
        epoch: The newest that world has written to its disk.
        rival: The desk of another cloud, if there is one.
        wall: Asked by a process that starts how old its key file is; None for not at all.
        listeners: Get world's new records and the instant [ns], every 100 ms.
    """

    def __init__(self, *settings: str, **options: Unpack[Options]) -> None:
        """Get ready; the mission is ordered at once.

        Args:
            settings: Over the experiment, as `--set` takes them.
            options: See `Options`.
        """
        seed = options.get("seed", 1)
        self.experiment = load_experiment("paper", [*settings, f"seed={seed}"])
        self.honest, self._keep = options.get("honest", True), options.get("keep", True)
        self._life, self._tempt = options.get("life", 1), options.get("tempt")
        self._second = options.get("second")
        shared = options.get("cloud_clock") is None
        self._clock = options.get("cloud_clock") or Clock()
        self._cloud_clock_id = SHARED if shared else OTHER
        secrets = options.get("secrets") or {"world": SECRET, "cloud": SECRET}
        self.secrets = {"rival": SECRET} | secrets
        self.rings: dict[str, KeyRing] = {}
        self.epoch = 0
        self.wall: Wall | None = None
        self.rival: Desk | None = None
        self.listeners: list[Callable[[list[Record], int], None]] = []
        self.generations = {"world": 0, "cloud": 0}
        self.of_world: list[Record] = []
        self.of_cloud: list[Record] = []
        self.changes: list[GuardChange] = []
        self._hash = RecordHash()
        self.watch = _watch(self.experiment)
        limit, path = self.experiment.criteria.contact_speed_max_mps, options.get("journal")
        goes_apart = options.get("apart", False)
        self.desk = apart(limit, path, seed) if goes_apart else Desk(limit, path)
        if options.get("start", True):
            self.order()
        self.world = Mortal(self._build_world, Clock())
        self.cloud = Mortal(self._build_cloud, self._clock, "cloud")
        self.desk.live(self.cloud)
        self.uplink = _link(self.experiment, options.get("uplink"), True)
        self.downlink = _link(self.experiment, options.get("downlink"), False)
        self.run = VirtualRun(self.world, self.cloud, self.uplink, self.downlink)

    @property
    def robot(self) -> Any:
        """The robot of the world that lives."""
        assert isinstance(self.world.inner, WorldEndpoint), "the world is down"
        return self.world.inner.robot

    @property
    def mission(self) -> Mission:
        """The mission ordered last."""
        return self.desk.last

    @property
    def now(self) -> float:
        """Virtual time [s]."""
        return self.run.now_ns * 1e-9

    def order(self, now_ns: int = 0, **options: Any) -> Mission:
        """Order the experiment's mission at an instant [ns] of virtual time."""
        plan = assembly.build_plan(self.experiment)
        contact = self.experiment.criteria.contact
        return self.desk.order(plan, self._clock.at(now_ns), contact=contact, **options)

    def ask_for_mission(self, now_ns: int) -> None:
        """Order it at an instant [ns] of virtual time, if it is taken."""
        plan = assembly.build_plan(self.experiment)
        order = Order(plan, contact=self.experiment.criteria.contact)
        self.desk.ask(lambda service, own_ns: service.create(order, own_ns), self._clock.at(now_ns))

    def fly(self, until: float, over: Callable[[], bool] = lambda: False) -> Flight:
        """Go on.

        Args:
            until: Instant of virtual time [s].
            over: Whether it is over before.
        """
        self.run.fly(over, round(until * 1e9), self._sink)
        return self

    def fly_mission(self, limit: float = 120.0) -> Flight:
        """Go on until the mission has ended and 1 s more.

        Args:
            limit: Latest instant [s].
        """
        self.fly(limit, lambda: self.desk.service is not None and self.mission.ended)
        return self.fly(self.now + 1.0)

    def kill_cloud(self, now_ns: int, down: float) -> None:
        """SIGKILL of cloud's process.

        Args:
            now_ns: When [ns].
            down: How long there is no new one [s].
        """
        self.cloud.kill(now_ns)
        self.cloud.at(now_ns * 1e-9 + down, self.cloud.start)

    def kill_cloud_pod(self, now_ns: int, down: float) -> None:
        """The whole pod is gone, teleop with it.

        Args:
            now_ns: When [ns].
            down: How long until all of it is back [s].
        """
        self.desk.kill()
        self.kill_cloud(now_ns, down)
        self.cloud.at(now_ns * 1e-9 + down, lambda _: self.desk.start())

    def kill_world(self, now_ns: int, down: float) -> None:
        """World's pod restarts: another world stands at the spawn.

        Args:
            now_ns: When [ns].
            down: How long there is none [s].
        """
        self.world.kill(now_ns)
        self.world.at(now_ns * 1e-9 + down, self.world.start)

    def rotate(self, end: str, keys: KeySet, now_ns: int) -> None:
        """Put another Secret before an end at an instant [ns]; one that is down reads it later."""
        self.secrets[end] = keys
        mortal = self.world if end == "world" else self.cloud
        self.rings[end].replace(keys, mortal.clock.at(now_ns))

    def send_rival_away(self) -> None:
        """The other cloud ends; the one that was first has to get the robot back."""
        if isinstance(self.cloud.inner, Crowd):
            self.cloud.inner.members = self.cloud.inner.members[:1]
        self._second = None

    def sha256(self) -> str:
        """Hash all records so far; only if they are kept."""
        return self._hash.hexdigest()

    def trajectory(self) -> list[GroundTruth]:
        """Where the robot was, every 10 ms."""
        return [record for record in self.of_world if isinstance(record, GroundTruth)]

    def count(self, name: str, end: str = "world") -> int:
        """How often something has happened at an end, as it was last told."""
        records = self.of_world if end == "world" else self.of_cloud
        totals = [r.total for r in records if isinstance(r, Counted) and r.name == name]
        return totals[-1] if totals else 0

    def _build_world(self, start_ns: int) -> WorldEndpoint:
        self.generations["world"] += 1
        nonce = b"world-%d-%d" % (self._life, self.generations["world"])
        identity = WorldIdentity(
            SHARED,
            nonce.ljust(16),
            ring=self._ring("world", start_ns),
            next_epoch=self._next_epoch,
        )
        world = assembly.build_world(self.experiment, identity, lambda: start_ns)
        self._born_ns = start_ns
        self.watch.attach(world, start_ns, honest=self.honest)
        return world

    def _build_cloud(self, start_ns: int) -> Endpoint:
        self.generations["cloud"] += 1
        nonce = b"cloud-%d-%d" % (self._life, self.generations["cloud"])
        identity = CloudIdentity(
            self._cloud_clock_id, nonce.ljust(16), self._ring("cloud", start_ns)
        )
        teleop = self.desk.join(start_ns)
        cloud = assembly.build_cloud(self.experiment, identity, lambda: start_ns, teleop)
        if self._tempt is not None:
            self._tempt(cloud)
        if self._second is not None:
            joins_ns = self._clock.at(round(self._second * 1e9))
            return Crowd([cloud, self._build_rival(max(joins_ns, start_ns))])
        return cloud

    def _build_rival(self, start_ns: int) -> CloudEndpoint:
        """Another cloud with the same key, which wants to fly the same mission."""
        limit = self.experiment.criteria.contact_speed_max_mps
        self.rival = Desk(limit, name=b"rival")
        self.rival.order(assembly.build_plan(self.experiment), start_ns)
        identity = CloudIdentity(SHARED, b"rival".ljust(16), self._ring("rival", start_ns))
        return assembly.build_cloud(self.experiment, identity, lambda: start_ns, self.rival)

    def _ring(self, end: str, now_ns: int) -> KeyRing:
        """The keys that a process reads at its start."""
        wall = self.wall.at(self.run.now_ns) if self.wall is not None else None
        ring = self.rings[end] = KeyRing(self.secrets[end], now_ns, wall)
        return ring

    def _next_epoch(self) -> int:
        """What world has written to its disk before it uses it."""
        self.epoch += 1
        return self.epoch

    def _sink(self, of_world: list[Record], of_cloud: list[Record]) -> None:
        if self._keep:
            self.of_world += of_world
            self.of_cloud += of_cloud
            self._hash.update(of_world)
            self._hash.update(of_cloud)
        self._note(of_world)
        for listen in self.listeners:
            listen(of_world, self.run.now_ns)

    def _note(self, records: Iterable[Record]) -> None:
        for record in records:
            kind = type(record)
            if kind is GuardChange:
                self.changes.append(record)  # type: ignore[arg-type]
            elif kind is Contact:
                state = states.state_before(self.changes, record.stamp_ns, self._born_ns)
                self.watch.see(record, state, self.honest)  # type: ignore[arg-type]

    def state_at(self, stamp_ns: int) -> GuardState:
        """The guard's state at an instant [ns, world's clock]."""
        return states.state_at(self.changes, stamp_ns, self._born_ns)

    def events(self, *names: str) -> list[MissionEvent]:
        """What has happened to missions, by name."""
        return [event for event in self.desk.events if event.event in names]


def _watch(experiment: ResolvedExperiment) -> Watch:
    guard = experiment.guard
    age_max_ns = round(guard.command_age_max_ms * 1e6)
    caps = guard.speed_max_mps, guard.acceleration_max_mps2, guard.yaw_rate_max_radps
    return Watch(*caps, age_max_ns, round(guard.hold_max_s * 1e9))


def _link(experiment: ResolvedExperiment, shape: Shape | None, up: bool) -> LinkDirection:
    profile = assembly.link_profile(experiment.uplink if up else experiment.downlink)
    return LinkDirection(shape(profile) if shape else profile, experiment.seed, uplink=up)
