"""What the process commands share: their flags, their socket addresses, their metrics.

What world and cloud open before they are built, from their flags, and how they fly then.
"""

from __future__ import annotations

import argparse
import os
import re
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cloudrc.errors import BadInputError

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


Address = tuple[str, int]
LOOPBACK_NAMES = ("localhost", "::1", "[::1]")
EPILOG = """\
'cloudrc run --mode local' starts this process with the flags that it needs.
It ends on SIGTERM, on Ctrl-C, and when the process that started it is gone."""


def process_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what every process takes."""
    parser.add_argument("--config", type=Path, required=True, metavar="FILE", help="the experiment")
    parser.add_argument(
        "--feed", action="store_true", help="tell a supervisor on stdout; else only events are said"
    )
    parser.add_argument(
        "--metrics",
        type=address,
        metavar="HOST:PORT",
        help="serve /metrics, /healthz and /readyz here (default: not at all)",
    )


def end_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare what an end of the tunnel takes."""
    process_arguments(parser)
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="MCAP file to write; one that is there is kept, as NAME.before.mcap",
    )
    parser.add_argument(
        "--record-flights",
        action="store_true",
        help="leave out what comes periodically while nothing flies",
    )
    parser.add_argument(
        "--record-max",
        type=size,
        metavar="SIZE",
        help="end the recording at nine tenths of this, one kept from before counted: 500M, 1Gi "
        "(default: no limit)",
    )
    parser.add_argument(
        "--listen", type=address, required=True, metavar="HOST:PORT", help="where to receive"
    )
    parser.add_argument(
        "--link",
        type=Path,
        metavar="FILE",
        help="where the link tells its state; its changes are recorded (default: link.json beside"
        " the route)",
    )
    parser.add_argument(
        "--key",
        type=Path,
        required=True,
        metavar="FILE",
        help="the tunnel's pre-shared key; followed while it flies ('cloudrc key new FILE')",
    )
    target = parser.add_mutually_exclusive_group(required=True)
    target.add_argument(
        "--peer", type=address, metavar="HOST:PORT", help="where to send; a name is resolved once"
    )
    target.add_argument(
        "--route",
        type=Path,
        metavar="FILE",
        help="file that says where to send, HOST:PORT with the host as a number; it is waited for"
        " and followed",
    )


def address(text: str) -> Address:
    """Read HOST:PORT, as argparse calls it."""
    host, _, port = text.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT")
    return host, int(port)


def resolve(name: str) -> list[str]:
    """Give the IPv4 addresses of a name; raises an OSError if there is none."""
    try:
        found = socket.getaddrinfo(name, None, socket.AF_INET, socket.SOCK_DGRAM)
    except UnicodeError as error:  # a label that is empty or too long
        raise OSError(f"not a name: {error}") from error
    return [str(entry[4][0]) for entry in found]


def resolved(flag: str, where: Address) -> Address:
    """Give an address in numbers, once and before the loop: that cannot wait for a name server.

    Raises:
        BadInputError: If its host cannot be resolved; names the flag.
    """
    host, port = where
    try:
        return resolve(host)[0], port
    except OSError as error:
        raise BadInputError(
            f"{flag} {host}:{port}: {host} cannot be resolved ({error.strerror or error}); name a"
            " host that has an IPv4 address, or the address itself"
        ) from error


def size(text: str) -> float:
    """Read an amount of bytes as Kubernetes writes it, as argparse calls it."""
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)(m|k|Ki|M|Mi|G|Gi|T|Ti)?", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' is not a size such as 500M or 1Gi")
    number, unit = found.groups(default="")
    factor = {"": 1.0, "m": 1e-3}.get(unit)
    if factor is None:
        base = 1024.0 if unit.endswith("i") else 1000.0
        factor = base ** ("kMGT".index(unit[0].replace("K", "k")) + 1)
    return float(number) * factor


def warn_if_exposed(listen: Address) -> None:
    """Say so if others than this machine can send to an address."""
    if not listen[0].startswith("127.") and listen[0] not in LOOPBACK_NAMES:
        print(f"cloudrc: warning: {listen[0]} can be reached from outside", file=sys.stderr)


def open_exporter(options: argparse.Namespace, role: str) -> Exporter | None:
    """Serve a process's metrics where its flags say; None if they do not."""
    if options.metrics is None:
        return None
    from cloudrc.drivers.exporter import Exporter

    warn_if_exposed(options.metrics)
    elsewhere = getattr(options, "teleop", None) is not None
    exporter = Exporter(role, missions=not elsewhere)
    exporter.serve(options.metrics)
    return exporter


@contextmanager
def listening(flag: str, listen: Address) -> Iterator[None]:
    """Open a socket at an address inside; if that fails, say which flag asked for what."""
    try:
        yield
    except OSError as error:
        raise BadInputError(
            f"{flag} {listen[0]}:{listen[1]}: cannot receive there: {error.strerror or error};"
            " name an address of this machine and a port that is free"
        ) from error


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
