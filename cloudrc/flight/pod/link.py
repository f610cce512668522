# SPDX-License-Identifier: Apache-2.0

"""Shape one direction of the link of a pod or local run, in a process of its own.

PUT /link on the Unix socket of --control changes the link. GET /link.json on the metrics port
returns the state of the shaper and the netem qdiscs of this pod or machine. The process calls tc
and ip for this answer.
"""

from __future__ import annotations

import json
import time
from contextlib import closing
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

from cloudrc.config.load import load_link, read_experiment, robot_settings
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.pod.link_control import ControlServer
from cloudrc.flight.pod.netem_tools import Programs, run_tool
from cloudrc.flight.pod.ports import ipv4_addresses, listening, open_exporter, repeat, warn
from cloudrc.flight.pod.process import Feed, StopSignal
from cloudrc.flight.pod.realtime import Address
from cloudrc.link.carry.punctual import ask_for_fifo, settle
from cloudrc.link.carry.udp import Relay
from cloudrc.link.follow import (
    PEER_PAUSE,
    PROFILE_PERIOD,
    Load,
    Loaded,
    PeerName,
    Profiles,
    load_way,
)
from cloudrc.link.model import LinkDirection
from cloudrc.link.netem import Netem, find_netems
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Make, Sidecar
from cloudrc.wire.tunnel.codec import peek

RELEASED_PERIOD = 1.0
"""Time between two updates of the file with the lateness of datagrams [s]."""
log = partial(warn, process="link")


@dataclass(frozen=True)
class LinkSettings:
    """Files and addresses of the process; a field is the flag of this name."""

    config: Path  # experiment file
    profile: Path  # of the link; watched for changes
    direction: Literal["uplink", "downlink"]
    mode: Literal["auto", "netem", "relay"]
    peer: Address  # the other tunnel end
    end: Address | None  # from which the own tunnel end sends
    listen: Address  # where the relay receives datagrams
    route: Path  # file for the address to which the own tunnel end must send
    origin: int  # start of the schedule, monotonic clock [ns]; 0: when the link comes up
    control: Path | None = None  # Unix socket on which the link can be changed
    feed: bool = False  # write status for a supervisor to stdout
    metrics: Address | None = None  # serve metrics here
    robot: int | None = None  # number in a fleet


def run_link(settings: LinkSettings, stop: StopSignal) -> None:
    """Shape one direction of the link until `stop`."""
    feed = Feed.on_stdout(watched=settings.feed)
    experiment = read_experiment(str(settings.config), robot_settings(settings.robot))
    exporter = open_exporter("link", experiment, settings.metrics)
    file, seed = settings.config.absolute(), experiment.seed
    load = make_profile_loader(settings.direction, file, seed)
    profiles = Profiles(settings.profile, load, log)
    profile, peer = profiles.first(), PeerName(settings.peer, ipv4_addresses, log)
    with (
        TemporaryDirectory(prefix="tc-", dir=settings.route.parent) as tables,
        closing(Programs(tables)) as programs,
    ):
        machine: dict[str, Any] = {"clock": time.monotonic_ns, "wait": time.sleep, "log": log}
        sidecar = Sidecar(
            relay=_relay_maker(settings, experiment),
            netem=partial(Netem, programs, tables=Path(tables), **machine),
            **machine,
            profile=profile,
            mode=settings.mode,
            direction=settings.direction,
            route=settings.route,
            origin_ns=settings.origin,
            tell=exporter.shaped if exporter else lambda state: None,
            count=exporter.counted if exporter else lambda counts: None,
        )

        def poll_profile() -> None:
            if loaded := profiles.poll():  # another thread may set a profile, too
                sidecar.profile = loaded

        def change(document: bytes) -> str:
            sidecar.profile = profiles.take(document, settings.route.parent)
            return sidecar.profile.change.number

        def resolve_peer() -> None:
            sidecar.peer = peer.poll() or sidecar.peer
            if exporter:
                exporter.unresolved(peer.failures)

        if exporter:
            exporter.link.tell = lambda: status_page(sidecar)
        if settings.control:
            ControlServer(settings.control, change, lambda: sidecar.state)
        repeat(poll_profile, PROFILE_PERIOD, PROFILE_PERIOD)
        repeat(resolve_peer, *PEER_PAUSE)
        repeat(sidecar.publish_released, RELEASED_PERIOD, RELEASED_PERIOD)
        alive = feed.alive_while(stop)
        sidecar.run(lambda: alive() if sidecar.state else stop())


def make_profile_loader(direction: str, experiment: Path, seed: int) -> Load:
    """Return a function that reads one direction of the link from a profile's file.

    The file may name the profile, or leave the link to the file `experiment`. The `seed` decides
    where a schedule at random begins.
    """

    def load(path: Path) -> Loaded:
        profile = load_link(path.absolute(), experiment)
        values = profile.model_dump(mode="json", exclude_defaults=True)
        return load_way(profile, direction, values, seed)

    return load


def _relay_maker(settings: LinkSettings, experiment: ResolvedExperiment) -> Make:
    seed, stream, is_up = experiment.seed, experiment.stream, settings.direction == "uplink"

    def relay(profile: DirectionProfile, origin_ns: int) -> Relay:
        settle()
        if ask_for_fifo():  # not in most pods, which do not need it
            log("the relay runs under SCHED_FIFO")
        direction = LinkDirection(profile, seed, is_up, origin_ns, stream=stream)
        with listening("--listen", settings.listen):
            return Relay(settings.listen, direction, peek, settings.end)

    return relay


def status_page(sidecar: Sidecar) -> str:
    """Return the state of a sidecar, and of this pod's netem qdiscs, as JSON, in any thread."""
    peer, state = sidecar.peer, sidecar.state
    netems = find_netems(run_tool, peer[0]) if peer else {}
    return json.dumps((asdict(state) if state else {}) | netems) + "\n"
