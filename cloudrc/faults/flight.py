"""A flight in virtual time in which everything can break, and everything is looked at.

Both ends are those of production, driven by the driver of production; around them lies what a
scenario needs: ends that die and return, an operator's desk with a journal, a watch over the
invariants, and questions about what happened.

How a flight of the fault suite may differ from the plain one.

Several clouds at one place: what arrives is heard by all of them, each sends what it wants.

Which state the guard was in: now, at an instant, and when something was touched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias, TypedDict, Unpack

from cloudrc import assembly
from cloudrc.cloud.endpoint import CloudEndpoint, CloudIdentity
from cloudrc.config.load import ResolvedExperiment, load_experiment
from cloudrc.drivers.virtual import VirtualRun
from cloudrc.endpoint import Endpoint
from cloudrc.faults.invariants import Watch
from cloudrc.faults.models import Clock, Desk, Mortal, apart
from cloudrc.faults.walls import Wall
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import Blackout, DirectionProfile
from cloudrc.messages import Cause, GuardState
from cloudrc.record.hash import RecordHash
from cloudrc.records import Contact, Counted, GroundTruth, GuardChange, MissionEvent, Record
from cloudrc.teleop.store import Mission, Order
from cloudrc.tunnel.keys import Key, KeyRing, KeySet
from cloudrc.world.endpoint import WorldEndpoint, WorldIdentity

Shape: TypeAlias = Callable[[DirectionProfile], DirectionProfile]
"""Changes the conditions of one direction of the link."""
SECRET = KeySet(Key(b"a key of the fault suite, 32 b.."))


class Options(TypedDict, total=False):
    """How a flight differs from the plain one.

    Attributes:
        seed: Of everything random; 1 by default.
        cloud_clock: Cloud's; by default the two ends share a clock.
        uplink: Changes the link's conditions from world to cloud.
        downlink: Likewise from cloud to world.
        honest: Whether a contact is the cloud's failure; it is by default.
        keep: Whether all records are kept and hashed; they are by default.
        start: Whether the experiment's mission is ordered; it is by default.
        life: Tells the processes of one flight from those of another, as nonces do.
        tempt: Makes a new cloud, which has valid keys, another one than it was.
        secrets: Key files by end; the same one for both by default.
        second: When another cloud wants the robot, too [s]; never by default.
        journal: Of teleop; in memory by default.
        apart: Whether teleop is a process of its own; it is in cloud's by default.
    """

    seed: int
    cloud_clock: Clock | None
    uplink: Shape | None
    downlink: Shape | None
    honest: bool
    keep: bool
    start: bool
    life: int
    tempt: Callable[[CloudEndpoint], None] | None
    secrets: dict[str, KeySet]
    second: float | None
    journal: Path
    apart: bool


def blackouts(*spans: tuple[float, float]) -> Shape:
    """Let nothing pass: each span is its start and its duration [s]."""
    return lambda profile: replace(
        profile, blackouts=(*profile.blackouts, *(Blackout(*span) for span in spans))
    )


class Crowd:
    """Endpoints that share a socket, each awake from its own instant on; an `Endpoint` itself.

    Attributes:
        members: Those that are there; the first one's story is what the recording tells.
        others: What the others have noted down, oldest first.
    """

    def __init__(self, members: Sequence[Endpoint]) -> None:
        self.members = members
        self.others: list[Record] = []

    @property
    def sealed(self) -> bool:
        """See `Endpoint`."""
        return all(member.sealed for member in self.members)

    def receive_datagram(self, data: bytes, now_ns: int) -> None:
        """See `Endpoint`."""
        for member in self.members:
            member.receive_datagram(data, now_ns)

    def next_deadline_ns(self) -> int:
        """See `Endpoint`."""
        return min(member.next_deadline_ns() for member in self.members)

    def handle_deadline(self, now_ns: int) -> None:
        """See `Endpoint`."""
        for member in self.members:
            if now_ns >= member.next_deadline_ns():
                member.handle_deadline(now_ns)

    def take_datagrams(self) -> list[bytes]:
        """See `Endpoint`."""
        return [data for member in self.members for data in member.take_datagrams()]

    def take_records(self) -> list[Record]:
        """See `Endpoint`; only those of the first."""
        first, *others = (member.take_records() for member in self.members)
        for records in others:
            self.others += records
        return first


GROUND, _, HOLD, LAND, ESTOP = GuardState
PERIOD_NS = 10_000_000
"""Of odometry, by which a contact is told [ns]: it began within so long before its stamp."""
BRAKES_NS = 200_000_000
"""Time within which a descent that the operator has acknowledged is stopped [ns].
Source: docs/reference/plant.md, "Stop rule"."""


def seen_now(world: Any) -> tuple[GuardState, str]:
    """Tell the state of the guard that lives, and why; a world that is down has none: GROUND.

    A new world notes no change before its first: what changed last may have been another's.

    Args:
        world: That end, or None.
    """
    if world is None:
        return GROUND, "the world is down"
    guard = world.robot.guard
    return guard.state, guard.cause.words


def state_at(changes: Sequence[GuardChange], stamp_ns: int, born_ns: int) -> GuardState:
    """Tell the guard's state at an instant.

    Args:
        changes: Of the guards of all worlds so far, in order.
        stamp_ns: When [ns, world's clock].
        born_ns: When the newest world began [ns].
    """
    change = _last(changes, stamp_ns, born_ns)
    return GROUND if change is None else change.state


def state_before(changes: Sequence[GuardChange], stamp_ns: int, born_ns: int) -> GuardState:
    """Tell the guard's state when a contact began, which may have stopped the rotors since.

    Args:
        changes: Of the guards of all worlds so far, in order.
        stamp_ns: Of the contact [ns, world's clock].
        born_ns: When the newest world began [ns].
    """
    change = _last(changes, stamp_ns, born_ns)
    if change is None:
        return GROUND
    state = change.state
    if state is ESTOP and change.cause != Cause.STOPPED.words:
        began_ns = stamp_ns - PERIOD_NS
        if change.stamp_ns > began_ns:  # it is what the contact did
            state = state_at(changes, change.stamp_ns - 1, born_ns)
    if state is HOLD and state_at(changes, stamp_ns - BRAKES_NS, born_ns) is LAND:
        state = LAND  # acknowledged right above a pipe that it was about to land on
    return state


def _last(changes: Sequence[GuardChange], stamp_ns: int, born_ns: int) -> GuardChange | None:
    """Find the last change up to an instant, in the world that lived then."""
    for change in reversed(changes):
        if change.stamp_ns <= stamp_ns:
            return None if change.stamp_ns < born_ns <= stamp_ns else change
    return None


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
        self.secrets[end] = self.rings[end].keys = keys

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
        identity = WorldIdentity(SHARED, nonce.ljust(16), self._ring("world"))
        world = assembly.build_world(self.experiment, identity, lambda: start_ns)
        self._born_ns = start_ns
        self.watch.attach(world, start_ns, honest=self.honest)
        return world

    def _build_cloud(self, start_ns: int) -> Endpoint:
        self.generations["cloud"] += 1
        nonce = b"cloud-%d-%d" % (self._life, self.generations["cloud"])
        identity = CloudIdentity(self._cloud_clock_id, nonce.ljust(16), self._ring("cloud"))
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
        identity = CloudIdentity(SHARED, b"rival".ljust(16), self._ring("rival"))
        return assembly.build_cloud(self.experiment, identity, lambda: start_ns, self.rival)

    def _ring(self, end: str) -> KeyRing:
        """The keys that a process reads at its start."""
        ring = self.rings[end] = KeyRing(self.secrets[end])
        return ring

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
                state = state_before(self.changes, record.stamp_ns, self._born_ns)
                self.watch.see(record, state, self.honest)  # type: ignore[arg-type]

    def state_at(self, stamp_ns: int) -> GuardState:
        """The guard's state at an instant [ns, world's clock]."""
        return state_at(self.changes, stamp_ns, self._born_ns)

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
