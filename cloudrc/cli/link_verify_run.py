"""What `cloudrc link verify` does: plan, start the link, probe it both ways, read back, judge.

How late the link's relays were while probes flew: asked all along, the worst is kept.

A relay tells of its last ten seconds only, and one that starves early may be well again at the end.

What a probe of the link looks like: its header over and over, so that damage to it is seen.

A link may be asked to flip bits. Whichever bit it is, most copies of the header are whole: they say
which probe it was, and that it is not as it was sent.

Two network namespaces joined by a cable, in which netem is verified as between two pods.

    [world's namespace] tunnel ======= tunnel [cloud's namespace]

They live as long as the test. Needs root; nothing outside them is touched.
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
from cloudrc.cli.link_processes import LOOPBACK, WAYS, Place, Shaping, refuse_impossible, shaping
from cloudrc.cli.link_run import look
from cloudrc.cli.link_verify_text import Said, describe, notes, on_correlation, shaper_in_words
from cloudrc.config import document
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
"""Between two questions [s]; each answer is of the ten seconds before."""
_UNKNOWN = Evidence()


class Told(Protocol):
    """Who tells how late it is: see `Shaping`."""

    def metrics(self) -> str:
        """What it counts, in Prometheus' text; "" if it does not answer."""
        ...


class LateWatch:
    """Asks both directions' relays on a thread of its own while it is entered."""

    def __init__(self, running: Mapping[str, Told], period: float = PERIOD) -> None:
        """Set up for the shapers of both directions; one question per `period` [s]."""
        self._running, self._period = running, period
        self._late: dict[str, float] = {}
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._ask_on, name="late", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *failure: object) -> None:
        self._over.set()
        self._thread.join(self._period)

    def look(self) -> None:
        """Ask once."""
        for way, one in self._running.items():
            late = of_metrics(samples(one.metrics()), 0, _UNKNOWN).late
            if late is not None:
                self._late[way] = max(late, self._late.get(way, 0.0))

    def worst(self, way: str, told: Evidence) -> Evidence:
        """Put the worst of a direction in place of what it tells at the end."""
        known = [late for late in (told.late, self._late.get(way)) if late is not None]
        return replace(told, late=max(known, default=None))

    def _ask_on(self) -> None:
        while not self._over.wait(self._period):
            self.look()


PROBE, TRAIN = 254, 255
"""Kinds that no end of a tunnel knows: these datagrams never leave this process's own link."""
EPOCH = 1


class Probes:
    """Writes and reads the probes of both directions.

    Attributes:
        damaged: Numbers of those that arrived, but not as they were sent, by direction.
    """

    def __init__(self, sizes: Mapping[str, int]) -> None:
        """Set up for probes of these sizes, UDP payload [bytes], by direction."""
        self._sizes = {way: {PROBE: size, TRAIN: SIZE} for way, size in sizes.items()}
        self.damaged: dict[str, set[int]] = {way: set() for way in sizes}

    def write(self, way: str, kind: int, number: int) -> bytes:
        """Make a probe."""
        header = codec.encode_header(kind, Direction[way.upper()], EPOCH, number)
        return _filled(header, self._sizes[way][kind])

    def read(self, data: bytes) -> tuple[int, int, int]:
        """Read kind, epoch and number, whichever bit was flipped; note whether any was.

        Raises:
            ValueError: If it is none of ours.
        """
        header = data[:HEADER_SIZE]
        whole = data == _filled(header, len(data))
        if not whole:
            places = range(0, len(data) - HEADER_SIZE + 1, HEADER_SIZE)
            copies = Counter(data[place : place + HEADER_SIZE] for place in places)
            if not copies:
                raise ValueError("too short")
            header = copies.most_common(1)[0][0]
        found = codec.peek(header)
        if not whole and found[0] == PROBE:
            self.damaged[Direction(header[1]).name.lower()].add(found[2])
        return found


def _filled(header: bytes, size: int) -> bytes:
    return (header * (size // HEADER_SIZE + 1))[:size]


BEGIN = 1.0
"""After the link came up the first probe leaves [s]."""
TELL_PERIOD = 1.3
"""The link's processes tell their counts once a second [s]."""
_PAUSE = 0.3
_QUIET_MIN, _QUIET_MAX = 0.5, 5.0

Tell = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Asked:
    """What is asked of one direction, and how it is found out."""

    plan: Plan
    trains: Trains | None


@dataclass(frozen=True, slots=True)
class Bank:
    """One end of the link: its socket, and where its direction's shaper runs."""

    own: socket.socket
    place: Place


def verify(
    experiment: ResolvedExperiment,
    title: str,
    shaper: str,
    seconds: float | None,
    tell: Tell,
    applied: Profile | None = None,
    meddle: Callable[[Mapping[str, Shaping]], None] | None = None,
    routes: Mapping[str, tuple[str, int]] | None = None,
) -> Said:
    """Find out whether the link of an experiment is what it is asked to be.

    Args:
        experiment: Says what is asked.
        title: Names it.
        shaper: "relay" or "netem".
        seconds: How long to probe [s]; None for as long as it takes.
        tell: Hears what is going on.
        applied: Profile in force in place of what is asked; here begin faults for tests.
        meddle: Is shown the link's processes before the first probe.
        routes: Where to send instead of where the link says, by direction.

    Raises:
        BadInputError: If the shaper cannot be what is asked.
    """
    refuse_impossible(experiment, shaper)
    tell("plans the probes")
    asked = plan(experiment, seconds, shaper)
    profile = applied or Profile(uplink=experiment.uplink, downlink=experiment.downlink)
    text = document.write(profile.model_dump(mode="json", exclude_defaults=True))
    with banks(shaper) as ends:
        places = {way: bank.place for way, bank in ends.items()}
        tell("starts the link")
        with shaping(places, dump(experiment), text, shaper) as running:
            if meddle:
                meddle(running)
            findings = probe(asked, ends, running, tell, routes)
    tell("")
    return Said(
        title=title,
        shaper=shaper_in_words(findings),
        findings=findings,
        probes={way: describe(one.plan, one.trains) for way, one in asked.items()},
        notes=_notes(experiment, asked, shaper),
        causes=find_causes(findings),
    )


def _notes(experiment: ResolvedExperiment, asked: Mapping[str, Asked], shaper: str) -> list[str]:
    """Say what is not judged, or more loosely."""
    said = [note for way, one in asked.items() for note in notes(way, one.plan, one.trains)]
    if shaper == "netem":
        for way in asked:
            profile = link_profile(getattr(experiment, way))
            said += on_correlation(way, profile.correlation if has_jitter(profile) else 0.0)
    return said


def plan(
    experiment: ResolvedExperiment, seconds: float | None, shaper: str = "relay"
) -> dict[str, Asked]:
    """Choose the probes of both directions, each as large as what flies there.

    Args:
        experiment: Says what is asked.
        seconds: How long to probe [s]; None for as long as it takes.
        shaper: "relay"; or "netem", which is judged by what it makes of a profile.
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
            plans[way] = make_plan(profile, size, seconds, BEGIN)
    after = BEGIN + max(one.duration for one in plans.values()) + 2.0 * _QUIET_MAX
    return {way: Asked(one, plan_trains(one.profile, after)) for way, one in plans.items()}


def _has_rate(one: Plan) -> bool:
    return one.profile.rate is not None or any(change.rate for change in one.profile.changes)


@contextlib.contextmanager
def banks(shaper: str) -> Iterator[dict[str, Bank]]:
    """Open both ends of a link: on the loopback for the relay, in two namespaces for netem."""
    if shaper == "netem":
        with banks_of_namespaces() as ends:
            yield ends
        return
    owns = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in WAYS]
    try:
        for one in owns:
            one.bind((LOOPBACK, 0))
        listens = [(LOOPBACK, port) for port in free_ports(2)]
        tells = [(LOOPBACK, port) for port in free_ports(2, socket.SOCK_STREAM)]
        peers = [one.getsockname() for one in reversed(owns)]
        yield {
            way: Bank(own, Place(peer, listen, told))
            for way, own, peer, listen, told in zip(WAYS, owns, peers, listens, tells, strict=True)
        }
    finally:
        for one in owns:
            one.close()


def probe(
    asked: Mapping[str, Asked],
    ends: Mapping[str, Bank],
    running: Mapping[str, Shaping],
    tell: Tell,
    routes: Mapping[str, tuple[str, int]] | None = None,
) -> dict[str, Findings]:
    """Send all probes and judge them.

    Args:
        asked: By direction.
        ends: Likewise: who sends.
        running: Likewise: who shapes.
        tell: Hears how far it is.
        routes: Where to send instead of where the link says.
    """
    probes = Probes({way: one.plan.schedule.size for way, one in asked.items()})
    shores = [
        Shore(
            ends[way].own,
            (routes or {}).get(way) or _route(running[way]),
            partial(probes.write, way),
        )
        for way in WAYS
    ]
    origin_ns = max(running[way].state().origin_ns or 0 for way in WAYS)
    begin_ns = max(time.monotonic_ns() + 50_000_000, origin_ns + round(BEGIN * 1e9))
    volleys = [_volley(asked[way].plan) for way in WAYS]
    longest = max(asked[way].plan.duration for way in WAYS)
    said, quiet = _told(tell, f"sends probes for {longest:.0f} s"), _quiet(asked)
    relays = {way: one for way, one in running.items() if not one.place.inside}
    with LateWatch(relays) as late:
        logs = sound(shores, volleys, probes.read, begin_ns=begin_ns, quiet=quiet, tell=said)
        time.sleep(TELL_PERIOD)
    evidence = {
        way: late.worst(way, _read_back(running[way], len(log.sent_ns)))
        for way, log in zip(WAYS, logs, strict=True)
    }
    drawn_out = _send_trains(asked, shores, probes, tell)
    findings = {}
    for way, log, drawn in zip(WAYS, logs, drawn_out, strict=True):
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
    asked: Mapping[str, Asked], shores: list[Shore], probes: Probes, tell: Tell
) -> list[list[float]]:
    """Measure the rates, where there are any; say how far trains were drawn out [s]."""
    trains = [asked[way].trains for way in WAYS]
    if not any(one and one.count for one in trains):
        return [[], []]
    volleys = [
        Volley(TRAIN, SIZE, round(one.period * 1e9), one.count, one.length) if one else None
        for one in trains
    ]
    begin_ns = time.monotonic_ns() + round(_PAUSE * 1e9)
    said = _told(tell, "sends trains")
    quiet = _quiet(asked)
    logs = sound(shores, volleys, probes.read, begin_ns=begin_ns, quiet=quiet, tell=said)
    return [
        spans(one.count, one.length, log.arrivals) if one else []
        for one, log in zip(trains, logs, strict=True)
    ]


def _read_back(one: Shaping, sent: int) -> Evidence:
    """Ask a shaper what it does."""
    state = one.state()
    in_force = Profile.model_validate_json(_json(state.profile))
    applied = link_profile(getattr(in_force, state.direction))
    known = Evidence(shaper=state.shaper, why=state.reason, layers=1, applied=applied)
    told = of_metrics(samples(one.metrics()), sent, known)
    found = with_near(told, look(one.place.peer[0], one.place.inside))
    if state.shaper != "netem":
        return found
    return replace(found, applied=found.applied and netem_makes(found.applied))


def _json(values: object) -> str:
    import json

    return json.dumps(values)


def _route(one: Shaping) -> tuple[str, int]:
    route = one.route()
    assert route is not None, "waited for"
    return route


def _volley(one: Plan) -> Volley:
    schedule = one.schedule
    return Volley(PROBE, schedule.size, round(schedule.period * 1e9), schedule.count)


def _quiet(asked: Mapping[str, Asked]) -> float:
    """Say for how long nothing may come before the last probe is given up [s]."""
    expects = [one.plan.expects for one in asked.values()]
    longest = max(one.mean.expected + 15.0 * one.deviation.expected for one in expects)
    return min(_QUIET_MAX, _QUIET_MIN + longest)


def _told(tell: Tell, what: str = "sends probes") -> Callable[[float], None]:
    return lambda share: tell(f"{what}: {share:.0%}")


DEVICE = "tunnel"
PORT, METRICS_PORT = 7400, 9102
HOSTS = {"uplink": "10.79.7.1", "downlink": "10.79.7.2"}
"""Addresses of the ends, by the direction that they send."""
_CLONE_NEWNET = 0x40000000  # linux include/uapi/linux/sched.h


@contextlib.contextmanager
def banks_of_namespaces() -> Iterator[dict[str, Bank]]:
    """Make the namespaces, and open a socket in each.

    Raises:
        MissingPrerequisiteError: If this user may not, or ip is missing.
    """
    if os.geteuid() != 0:
        raise MissingPrerequisiteError(
            "netem is verified between two network namespaces, which takes root; run this as root,"
            " or verify the relay (--shaper relay)"
        )
    names = {way: f"cloudrc-{way}-{os.getpid()}" for way in WAYS}
    owns: list[socket.socket] = []
    try:
        _join(names)
        for way in WAYS:
            with _inside(names[way]):
                owns.append(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            owns[-1].bind((HOSTS[way], PORT))
        yield {way: Bank(own, _place(way, names[way])) for way, own in zip(WAYS, owns, strict=True)}
    finally:
        for own in owns:
            own.close()
        for name in names.values():
            with contextlib.suppress(MissingPrerequisiteError):
                _ip("netns", "del", name)


def _place(way: str, name: str) -> Place:
    other = next(one for one in WAYS if one != way)
    return Place(
        peer=(HOSTS[other], PORT),
        listen=(LOOPBACK, PORT + 1),
        metrics=(LOOPBACK, METRICS_PORT),
        inside=("ip", "netns", "exec", name),
    )


def _join(names: dict[str, str]) -> None:
    """Make both namespaces and the cable."""
    near, far = (names[way] for way in WAYS)
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
    """Be in a namespace with this thread; sockets that are opened there stay there."""
    library = ctypes.CDLL(None, use_errno=True)  # os.setns is Python 3.12's
    with open("/proc/thread-self/ns/net") as home, open(f"/run/netns/{name}") as there:
        if library.setns(there.fileno(), _CLONE_NEWNET):
            raise MissingPrerequisiteError(
                f"cannot enter the namespace {name}: {os.strerror(ctypes.get_errno())}; use "
                "--shaper relay"
            )
        try:
            yield
        finally:
            library.setns(home.fileno(), _CLONE_NEWNET)
