"""Verify a link on this machine: plan, start the link, probe both directions, judge.

A probe repeats its header to its full length. If the link flips a bit, most copies of the header
are still intact: they identify the probe and show the damage.

A relay reports its lateness of the last ten seconds only, so it is polled during the whole test.

netem is verified between two network namespaces, joined by a veth pair, as between two pods:

    [world's namespace] tunnel ======= tunnel [cloud's namespace]

This needs root, changes nothing outside the namespaces, and deletes them at the end.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Protocol, Self

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.cli.link_processes import (
    DIRECTIONS,
    LOOPBACK,
    ShaperAddresses,
    ShaperProcess,
    check_shaper,
    run_shapers,
)
from cloudrc.cli.link_run import inspect_network
from cloudrc.cli.link_verify_text import (
    VerifyReport,
    describe,
    notes,
    on_correlation,
    shaper_in_words,
)
from cloudrc.config.document import write_yaml
from cloudrc.config.load import dump
from cloudrc.config.schema import Profile
from cloudrc.drivers.realtime import free_ports
from cloudrc.errors import MissingPrerequisiteError
from cloudrc.link.verify.causes import (
    Evidence,
    Findings,
    find_causes,
    of_metrics,
    samples,
    with_near,
)
from cloudrc.link.verify.expect import as_sent, has_jitter, netem_makes
from cloudrc.link.verify.judge import SIZE, Trains, judge, plan_trains, spans
from cloudrc.link.verify.measure import measure
from cloudrc.link.verify.plan import Plan, make_plan
from cloudrc.link.verify.probe import Shore, Volley, sound
from cloudrc.link.verify.reference import frame_of
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import HEADER_SIZE, Direction, Kind

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment


PERIOD = 4.0
"""Pause between two polls of the lateness [s]; an answer covers the last ten seconds."""
_UNKNOWN = Evidence()


class MetricsSource(Protocol):
    """A source of metrics, such as `Shaping`."""

    def metrics(self) -> str:
        """Return the metrics as Prometheus text; "" without an answer."""
        ...


class LatenessWatch:
    """Poll the lateness of both relays on its own thread, as a context manager."""

    def __init__(self, running: Mapping[str, MetricsSource], period: float = PERIOD) -> None:
        """Store the shapers of both directions; poll them once per `period` [s]."""
        self._running, self._period = running, period
        self._late: dict[str, float] = {}
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._poll, name="late", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self._stopped.set()
        self._thread.join(self._period)

    def look(self) -> None:
        """Poll both shapers once."""
        for way, one in self._running.items():
            late = of_metrics(samples(one.metrics()), 0, _UNKNOWN).late
            if late is not None:
                self._late[way] = max(late, self._late.get(way, 0.0))

    def worst(self, way: str, evidence: Evidence) -> Evidence:
        """Replace the last lateness in the evidence by the worst one of the direction."""
        known = [late for late in (evidence.late, self._late.get(way)) if late is not None]
        return replace(evidence, late=max(known, default=None))

    def _poll(self) -> None:
        while not self._stopped.wait(self._period):
            self.look()


PROBE, TRAIN = 254, 255
"""Kinds of datagrams that only this module uses; no tunnel end accepts them."""
EPOCH = 1


class Probes:
    """Write and read the probes of both directions.

    Attributes:
        damaged: Numbers of the probes that arrived damaged, by direction.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        """Store the sizes of the probes by direction, UDP payload [bytes]."""
        self._sizes = {way: {PROBE: size, TRAIN: SIZE} for way, size in sizes.items()}
        self.damaged: dict[str, set[int]] = {way: set() for way in sizes}

    def write(self, way: str, kind: int, number: int) -> bytes:
        """Encode a probe."""
        header = codec.encode_header(kind, Direction[way.upper()], EPOCH, number)
        return _filled(header, self._sizes[way][kind])

    def read(self, data: bytes) -> tuple[int, int, int]:
        """Decode kind, epoch and number even if bits were flipped; record the damage.

        Raises:
            ValueError: If it is no probe.
        """
        header = data[:HEADER_SIZE]
        intact = data == _filled(header, len(data))
        if not intact:
            offsets = range(0, len(data) - HEADER_SIZE + 1, HEADER_SIZE)
            copies = Counter(data[offset : offset + HEADER_SIZE] for offset in offsets)
            if not copies:
                raise ValueError("too short")
            header = copies.most_common(1)[0][0]
        found = codec.peek(header)
        if not intact and found[0] == PROBE:
            self.damaged[Direction(header[1]).name.lower()].add(found[2])
        return found


def _filled(header: bytes, size: int) -> bytes:
    return (header * (size // HEADER_SIZE + 1))[:size]


FIRST_PROBE_DELAY = 1.0
"""Time from the start of the link to the first probe [s]."""
COUNTS_WAIT = 1.3
"""Wait before reading the counts [s]; the link's processes update them once a second."""
_PAUSE = 0.3
_QUIET_MIN, _QUIET_MAX = 0.5, 5.0

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class DirectionPlan:
    """Plan for verifying one direction.

    Attributes:
        plan: Schedule of the probes and the expected measurements.
        trains: Trains of datagrams that measure the rate; None without them.
    """

    plan: Plan
    trains: Trains | None


@dataclass(frozen=True, slots=True)
class ProbeEndpoint:
    """One end of the link.

    Attributes:
        own: Socket that sends and receives probes.
        place: Addresses of the shaper of its direction.
    """

    own: socket.socket
    place: ShaperAddresses


def verify(
    experiment: ResolvedExperiment,
    title: str,
    shaper: str,
    seconds: float | None,
    tell: Tell,
    applied: Profile | None = None,
    meddle: Callable[[Mapping[str, ShaperProcess]], None] | None = None,
    routes: Mapping[str, tuple[str, int]] | None = None,
) -> VerifyReport:
    """Measure whether the link of an experiment matches its profile.

    Args:
        experiment: The experiment.
        title: Its name, for the report.
        shaper: "relay" or "netem".
        seconds: Time to send probes [s]; None for as long as needed.
        tell: Receives progress as text.
        applied: Profile to apply instead of the requested one; tests inject faults with it.
        meddle: Gets the link's processes before the first probe; tests inject faults with it.
        routes: Addresses to send to instead of the link's own, by direction; for tests.

    Raises:
        BadInputError: If the shaper cannot realise the profile.
    """
    check_shaper(experiment, shaper)
    tell("planning the probes")
    asked = plan(experiment, seconds, shaper)
    profile = applied or Profile(uplink=experiment.uplink, downlink=experiment.downlink)
    text = write_yaml(profile.model_dump(mode="json", exclude_defaults=True))
    with open_probe_endpoints(shaper) as ends:
        places = {way: bank.place for way, bank in ends.items()}
        tell("starting the link")
        with run_shapers(places, dump(experiment), text, shaper) as running:
            if meddle:
                meddle(running)
            findings = probe_link(asked, ends, running, tell, routes)
    tell("")
    return VerifyReport(
        title=title,
        shaper=shaper_in_words(findings),
        findings=findings,
        probes={way: describe(one.plan, one.trains) for way, one in asked.items()},
        notes=_notes(experiment, asked, shaper),
        causes=find_causes(findings),
    )


def _notes(
    experiment: ResolvedExperiment, asked: Mapping[str, DirectionPlan], shaper: str
) -> list[str]:
    """Collect the notes on what is judged loosely or not at all."""
    found = [note for way, one in asked.items() for note in notes(way, one.plan, one.trains)]
    if shaper == "netem":
        for way in asked:
            profile = link_profile(getattr(experiment, way))
            found += on_correlation(way, profile.correlation if has_jitter(profile) else 0.0)
    return found


def plan(
    experiment: ResolvedExperiment, seconds: float | None, shaper: str = "relay"
) -> dict[str, DirectionPlan]:
    """Plan the probes of both directions, as large as the tunnel's own datagrams.

    Args:
        experiment: The experiment.
        seconds: Time to send probes [s]; None for as long as needed.
        shaper: "relay", or "netem", which is judged by its approximation of the profile.
    """
    kinds = {"uplink": Kind.TELEMETRY, "downlink": Kind.COMMAND}
    plans: dict[str, Plan] = {}
    for way, kind in kinds.items():
        profile = link_profile(getattr(experiment, way))
        profile = netem_makes(profile) if shaper == "netem" else profile
        size = codec.SIZES[kind]
        before = plans.get("uplink")
        if before and before.profile == profile and not _has_rate(before):
            plans[way] = replace(before, schedule=replace(before.schedule, size=size))
        else:
            plans[way] = make_plan(profile, size, seconds, FIRST_PROBE_DELAY)
    after = FIRST_PROBE_DELAY + max(one.duration for one in plans.values()) + 2.0 * _QUIET_MAX
    return {way: DirectionPlan(one, plan_trains(one.profile, after)) for way, one in plans.items()}


def _has_rate(one: Plan) -> bool:
    return one.profile.rate is not None or any(change.rate for change in one.profile.changes)


@contextlib.contextmanager
def open_probe_endpoints(shaper: str) -> Iterator[dict[str, ProbeEndpoint]]:
    """Open both ends of a link: on loopback for the relay, in two namespaces for netem."""
    if shaper == "netem":
        with open_namespace_endpoints() as ends:
            yield ends
        return
    owns = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in DIRECTIONS]
    try:
        for one in owns:
            one.bind((LOOPBACK, 0))
        listens = [(LOOPBACK, port) for port in free_ports(2)]
        metrics = [(LOOPBACK, port) for port in free_ports(2, socket.SOCK_STREAM)]
        peers = [one.getsockname() for one in reversed(owns)]
        yield {
            way: ProbeEndpoint(own, ShaperAddresses(peer, listen, at))
            for way, own, peer, listen, at in zip(
                DIRECTIONS, owns, peers, listens, metrics, strict=True
            )
        }
    finally:
        for one in owns:
            one.close()


def probe_link(
    asked: Mapping[str, DirectionPlan],
    ends: Mapping[str, ProbeEndpoint],
    running: Mapping[str, ShaperProcess],
    tell: Tell,
    routes: Mapping[str, tuple[str, int]] | None = None,
) -> dict[str, Findings]:
    """Send all probes and judge them.

    Args:
        asked: Plans by direction.
        ends: Sending ends by direction.
        running: Shapers by direction.
        tell: Receives progress as text.
        routes: Addresses to send to instead of the link's own, by direction.
    """
    probes = Probes({way: one.plan.schedule.size for way, one in asked.items()})
    shores = [
        Shore(
            ends[way].own,
            (routes or {}).get(way) or _route(running[way]),
            partial(probes.write, way),
        )
        for way in DIRECTIONS
    ]
    origin_ns = max(running[way].state().origin_ns or 0 for way in DIRECTIONS)
    begin_ns = max(time.monotonic_ns() + 50_000_000, origin_ns + round(FIRST_PROBE_DELAY * 1e9))
    volleys = [_volley(asked[way].plan) for way in DIRECTIONS]
    longest = max(asked[way].plan.duration for way in DIRECTIONS)
    progress, quiet = _progress(tell, f"sending probes for {longest:.0f} s"), _quiet(asked)
    relays = {way: one for way, one in running.items() if not one.place.inside}
    with LatenessWatch(relays) as late:
        logs = sound(shores, volleys, probes.read, begin_ns=begin_ns, quiet=quiet, tell=progress)
        time.sleep(COUNTS_WAIT)
    evidence = {
        way: late.worst(way, _read_back(running[way], len(log.sent_ns)))
        for way, log in zip(DIRECTIONS, logs, strict=True)
    }
    durations = _send_trains(asked, shores, probes, tell)
    findings = {}
    for way, log, drawn in zip(DIRECTIONS, logs, durations, strict=True):
        sent = np.array([stamp_ns - origin_ns for stamp_ns in log.sent_ns]) * 1e-9
        one = asked[way].plan
        expects = as_sent(one.expects, one.profile, sent, one.schedule.size)
        frame, damaged = frame_of(one.profile, sent), len(probes.damaged[way])
        measured = measure(log, expects.over_time, drawn, frame, damaged)
        real = replace(one, expects=expects)
        rows = judge(real, measured, asked[way].trains, evidence[way].applied)
        findings[way] = Findings(rows, evidence[way])
    return findings


def _send_trains(
    asked: Mapping[str, DirectionPlan], shores: list[Shore], probes: Probes, tell: Tell
) -> list[list[float]]:
    """Send trains where a rate is to be measured; return their received durations [s]."""
    trains = [asked[way].trains for way in DIRECTIONS]
    if not any(one and one.count for one in trains):
        return [[], []]
    volleys = [
        Volley(TRAIN, SIZE, round(one.period * 1e9), one.count, one.length) if one else None
        for one in trains
    ]
    begin_ns = time.monotonic_ns() + round(_PAUSE * 1e9)
    progress = _progress(tell, "sending trains")
    quiet = _quiet(asked)
    logs = sound(shores, volleys, probes.read, begin_ns=begin_ns, quiet=quiet, tell=progress)
    return [
        spans(one.count, one.length, log.arrivals) if one else []
        for one, log in zip(trains, logs, strict=True)
    ]


def _read_back(one: ShaperProcess, sent: int) -> Evidence:
    """Read back what a shaper does and has counted."""
    state = one.state()
    in_force = Profile.model_validate_json(_json(state.profile))
    applied = link_profile(getattr(in_force, state.direction))
    known = Evidence(shaper=state.shaper, why=state.reason, layers=1, applied=applied)
    counted = of_metrics(samples(one.metrics()), sent, known)
    found = with_near(counted, inspect_network(one.place.peer[0], one.place.inside))
    if state.shaper != "netem":
        return found
    return replace(found, applied=found.applied and netem_makes(found.applied))


def _json(values: object) -> str:
    import json

    return json.dumps(values)


def _route(one: ShaperProcess) -> tuple[str, int]:
    route = one.route()
    assert route is not None, "shaping() waits for it"
    return route


def _volley(one: Plan) -> Volley:
    schedule = one.schedule
    return Volley(PROBE, schedule.size, round(schedule.period * 1e9), schedule.count)


def _quiet(asked: Mapping[str, DirectionPlan]) -> float:
    """Return the silence after which missing probes count as lost [s]."""
    expects = [one.plan.expects for one in asked.values()]
    longest = max(one.mean.expected + 15.0 * one.deviation.expected for one in expects)
    return min(_QUIET_MAX, _QUIET_MIN + longest)


def _progress(tell: Tell, what: str) -> Callable[[float], None]:
    return lambda share: tell(f"{what}: {share:.0%}")


DEVICE = "tunnel"
PORT, METRICS_PORT = 7400, 9102
HOSTS = {"uplink": "10.79.7.1", "downlink": "10.79.7.2"}
"""Direction -> address of the end that sends in this direction."""
_CLONE_NEWNET = 0x40000000  # linux include/uapi/linux/sched.h


@contextlib.contextmanager
def open_namespace_endpoints() -> Iterator[dict[str, ProbeEndpoint]]:
    """Create two namespaces and open a socket in each.

    Raises:
        MissingPrerequisiteError: If this user is not root, or ip is missing.
    """
    if os.geteuid() != 0:
        raise MissingPrerequisiteError(
            "netem is verified between two network namespaces, which needs root; run this as root,"
            " or verify the relay (--shaper relay)"
        )
    names = {way: f"cloudrc-{way}-{os.getpid()}" for way in DIRECTIONS}
    owns: list[socket.socket] = []
    try:
        _join(names)
        for way in DIRECTIONS:
            with _inside(names[way]):
                owns.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            owns[-1].bind((HOSTS[way], PORT))
        yield {
            way: ProbeEndpoint(own, _place(way, names[way]))
            for way, own in zip(DIRECTIONS, owns, strict=True)
        }
    finally:
        for own in owns:
            own.close()
        for name in names.values():
            with contextlib.suppress(MissingPrerequisiteError):
                _ip("netns", "del", name)


def _place(way: str, name: str) -> ShaperAddresses:
    other = next(one for one in DIRECTIONS if one != way)
    return ShaperAddresses(
        peer=(HOSTS[other], PORT),
        listen=(LOOPBACK, PORT + 1),
        metrics=(LOOPBACK, METRICS_PORT),
        inside=("ip", "netns", "exec", name),
    )


def _join(names: dict[str, str]) -> None:
    """Create both namespaces and join them with a veth pair."""
    near, far = (names[way] for way in DIRECTIONS)
    for name in (near, far):
        _ip("netns", "add", name)
    _ip("-n", near, "link", "add", DEVICE, "type", "veth", "peer", DEVICE, "netns", far)
    for way, name in names.items():
        _ip("-n", name, "addr", "add", f"{HOSTS[way]}/24", "dev", DEVICE)
        for device in ("lo", DEVICE):
            _ip("-n", name, "link", "set", device, "up")


def _ip(*words: str) -> str:
    return _run("ip", *words)


def _run(*words: str) -> str:
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=10.0, check=False)
    except FileNotFoundError:
        raise MissingPrerequisiteError(
            f"no program {words[0]} (package iproute2); install it, or use --shaper relay"
        ) from None
    if done.returncode:
        raise MissingPrerequisiteError(
            f"'{' '.join(words)}' failed: {' '.join(done.stderr.split())}; use --shaper relay"
        )
    return done.stdout


@contextlib.contextmanager
def _inside(name: str) -> Iterator[None]:
    """Move this thread into a namespace; sockets opened there stay there."""
    library = ctypes.CDLL(None, use_errno=True)  # os.setns exists from Python 3.12 only
    with open("/proc/thread-self/ns/net") as home, open(f"/run/netns/{name}") as target:
        if library.setns(target.fileno(), _CLONE_NEWNET):
            raise MissingPrerequisiteError(
                f"cannot enter the namespace {name}: {os.strerror(ctypes.get_errno())}; use "
                "--shaper relay"
            )
        try:
            yield
        finally:
            library.setns(home.fileno(), _CLONE_NEWNET)
