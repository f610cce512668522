"""What world and cloud open before they are built, from their flags, and how they fly then."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cloudrc.cli.ends import listening, open_exporter, resolved, warn_if_exposed

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.drivers.keyfile import KeyFile
    from cloudrc.drivers.realtime import Peer
    from cloudrc.endpoint import Endpoint
    from cloudrc.link.profile import DirectionProfile
    from cloudrc.link.verify.monitor import StandingCheck
    from cloudrc.record.recorder import Recorder
    from cloudrc.records import Record

TRACE_MAX = 2 << 20
"""Of a trace that the link's container names [bytes]: its own come from a ConfigMap of 1 MiB."""


class Opened(NamedTuple):
    """What an end has before it is built, and flies with.

    Attributes:
        options: The command's.
        name: "world" or "cloud".
        exporter: Of its metrics; None if nobody wants them.
        experiment: What it flies.
        clock: Which machine's clock it has.
        recorder: Where its records go.
        keys: The tunnel's.
        peer: Its socket.
    """

    options: argparse.Namespace
    name: str
    exporter: Exporter | None
    experiment: ResolvedExperiment
    clock: bytes
    recorder: Recorder
    keys: KeyFile
    peer: Peer

    def fly(
        self,
        endpoint: Endpoint,
        stop: Callable[[], bool],
        flies: Callable[[], bool],
        *,
        over: Callable[[], bool] = lambda: False,
        slip_ns: Callable[[], int] = lambda: 0,
    ) -> None:
        """Fly the end that was built, as `process.run_end`; `flies` says whether it does now."""
        from cloudrc.drivers.process import run_end

        options = self.options
        run_end(
            endpoint,
            self.peer,
            self.recorder,
            end=self.name,
            stop=stop,
            over=over,
            slip_ns=slip_ns,
            exporter=self.exporter,
            watched=options.feed,
            choose=_chosen(options, flies),
            link=_link_state(options),
            check=_standing_check(options, self.experiment, uplink=self.name == "cloud"),
            keys=self.keys,
        )


def open_end(options: argparse.Namespace, name: str) -> Opened:
    """Open what the "world" or the "cloud" needs; what cannot be had is said by its flag."""
    from cloudrc.config.load import fingerprint, load_experiment, read_experiment
    from cloudrc.drivers.machine import clock_id

    exporter, path, clock = open_exporter(options, name), str(options.config), clock_id()
    given = read_experiment(path)
    # Cloud alone flies by plug-ins, which fill in what the file leaves to them.
    experiment = load_experiment(path) if name == "cloud" else given
    if exporter is not None:
        exporter.runs(fingerprint(given))
    keys, peer = _open_keys(options), _open_peer(options)
    recorder = _open_recorder(options, name, clock)  # last: whoever cannot fly moves no recording
    return Opened(options, name, exporter, experiment, clock, recorder, keys, peer)


def suite() -> int:
    """The cipher that this machine is fast at."""
    from cloudrc.drivers.machine import has_fast_aes
    from cloudrc.tunnel.session import AES_256_GCM, CHACHA20_POLY1305

    return AES_256_GCM if has_fast_aes() else CHACHA20_POLY1305


def _open_keys(options: argparse.Namespace) -> KeyFile:
    """Read the key of an end."""
    import time

    from cloudrc.drivers.keyfile import KeyFile, is_exposed

    # Asked once, before anything flies, and for this alone: how old is a key that was replaced?
    keys = KeyFile(options.key, time.monotonic_ns(), time.time())
    if is_exposed(options.key):
        print(f"cloudrc: warning: everybody can read {options.key}: chmod 600", file=sys.stderr)
    return keys


def _open_peer(options: argparse.Namespace) -> Peer:
    """Bind the socket of an end, which sends to its peer or where its route leads."""
    from cloudrc.drivers.realtime import Peer, Route

    warn_if_exposed(options.listen)
    where = resolved("--peer", options.peer) if options.route is None else Route(options.route)
    if options.route is not None and not options.route.exists():
        print(f"cloudrc: nothing is sent until there is {options.route}", file=sys.stderr)
    with listening("--listen", options.listen):
        return Peer.bind(options.listen, where)


def _open_recorder(options: argparse.Namespace, clock: str, clock_id: bytes) -> Recorder:
    """Make the recorder of a process; without a file it writes into nothing."""
    from cloudrc.record.recorder import Recorder
    from cloudrc.record.writer import McapWriter

    path: Path = options.record or Path(os.devnull)
    before, size_max = _keep_before(path), None
    if options.record_max:
        room = round(0.9 * options.record_max)
        size_max = max(room - before, room // 10)  # both together, which share a volume
    return Recorder(
        path,
        lambda file: McapWriter(file, clock=clock, clock_id=clock_id.hex()),
        size_max=size_max,
    )


def _keep_before(path: Path) -> int:
    """Keep what the process before this one has recorded, as world.before.mcap; its size [bytes].

    A container that is started again finds the volume as it was, and so what led to its end.
    """
    try:
        size = path.stat().st_size if path.is_file() else 0
        if size:
            path.replace(path.with_name(f"{path.stem}.before{path.suffix}"))
    except OSError:  # whoever writes meets it again, and says so
        return 0
    return size


def _chosen(
    options: argparse.Namespace, flies: Callable[[], bool]
) -> Callable[[list[Record]], list[Record]]:
    """What chooses the records for the recording."""
    from cloudrc.drivers.recording import FlightsOnly

    return FlightsOnly(flies) if options.record_flights else list


def _link_state(options: argparse.Namespace) -> Path | None:
    """Find where the link of an end tells its state: the link's process writes it."""
    given: Path | None = options.link
    route: Path | None = options.route
    return given if given is not None or route is None else route.with_name("link.json")


def _standing_check(
    options: argparse.Namespace, experiment: ResolvedExperiment, *, uplink: bool
) -> StandingCheck:
    """Judge the direction that an end hears by what is asked of it, and follow what that is."""
    import json

    from cloudrc.assembly import link_profile
    from cloudrc.config.schema import Profile
    from cloudrc.link.traces import SIZE_MAX
    from cloudrc.link.verify.monitor import StandingCheck
    from cloudrc.link.verify.twin import Stream
    from cloudrc.tunnel.codec import SIZES, Kind

    def load(values: object) -> tuple[DirectionProfile, DirectionProfile]:
        profile = Profile.model_validate_json(json.dumps(values))
        return link_profile(profile.uplink, file_max), link_profile(profile.downlink, file_max)

    # Where the route is followed the link is a container, which may be anybody's by now.
    file_max = TRACE_MAX if options.link is None else SIZE_MAX
    asked = link_profile(experiment.uplink), link_profile(experiment.downlink)
    kind = Kind.TELEMETRY if uplink else Kind.COMMAND
    stream = Stream(experiment.seed, uplink, kind, SIZES[kind])
    check = StandingCheck(uplink=uplink, stream=stream)
    check.begin(asked, _link_state(options), load)
    return check
