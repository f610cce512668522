"""What `cloudrc link verify` does: plan, start the link, probe it both ways, read back, judge."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.cli.link_processes import LOOPBACK, WAYS, Place, Shaping, refuse_impossible, shaping
from cloudrc.cli.link_told import look
from cloudrc.cli.link_verify_late import LateWatch
from cloudrc.cli.link_verify_notes import describe, notes, on_correlation, shaper_in_words
from cloudrc.cli.link_verify_probes import PROBE, TRAIN, Probes
from cloudrc.cli.link_verify_text import Said
from cloudrc.config import document
from cloudrc.config.load import dump
from cloudrc.config.schema import Profile
from cloudrc.drivers.realtime import free_ports
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
from cloudrc.tunnel.codec import Kind

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment

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
        from cloudrc.cli.link_verify_netem import banks_of_namespaces

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
