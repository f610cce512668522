"""Flags, sockets, keys, recordings and metrics that the process commands share.

`open_end` opens them for world and cloud; `EndRuntime.fly` then runs the end.
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
    from cloudrc.link.verify.monitor import LinkMonitor
    from cloudrc.record.recorder import Recorder
    from cloudrc.records import Record


Address = tuple[str, int]
LOOPBACK_NAMES = ("localhost", "::1")
EPILOG = """\
'cloudrc run --mode local' starts this process with all the flags it needs.
It ends on SIGTERM, on Ctrl-C, and when the process that started it ends."""


def process_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of every process."""
    parser.add_argument(
        "--config", type=Path, required=True, metavar="FILE", help="experiment file (YAML)"
    )
    parser.add_argument(
        "--feed",
        action="store_true",
        help="write status for a supervisor to stdout (default: print events only)",
    )
    parser.add_argument(
        "--metrics",
        type=read_address,
        metavar="HOST:PORT",
        help="serve /metrics, /healthz and /readyz at this address (default: off)",
    )


def end_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags of world and cloud."""
    process_arguments(parser)
    parser.add_argument(
        "--record",
        type=Path,
        metavar="FILE",
        help="MCAP file to write; an existing one is renamed to NAME.before.mcap",
    )
    parser.add_argument(
        "--record-flights",
        action="store_true",
        help="leave out periodic records while the robot is not flying",
    )
    parser.add_argument(
        "--record-max",
        type=read_size,
        metavar="SIZE",
        help="size limit, such as 500M or 1Gi, for this recording and the renamed one together;"
        " recording ends at 90 %% of it (default: no limit)",
    )
    parser.add_argument(
        "--listen",
        type=read_address,
        required=True,
        metavar="HOST:PORT",
        help="address to receive at",
    )
    parser.add_argument(
        "--link",
        type=Path,
        metavar="FILE",
        help="file with the link's state, to be recorded (default: link.json beside --route)",
    )
    parser.add_argument(
        "--key",
        type=Path,
        required=True,
        metavar="FILE",
        help="the tunnel's pre-shared key ('cloudrc key new FILE'); it may change in flight",
    )
    _target_arguments(parser.add_mutually_exclusive_group(required=True))


def _target_arguments(target: argparse._MutuallyExclusiveGroup) -> None:
    """Declare the flags for an end's destination: a fixed peer, or a file that names the peer."""
    target.add_argument(
        "--peer",
        type=read_address,
        metavar="HOST:PORT",
        help="address to send to; a name is resolved once",
    )
    target.add_argument(
        "--route",
        type=Path,
        metavar="FILE",
        help="file with the numeric HOST:PORT to send to; it may appear or change later",
    )


def read_address(text: str) -> Address:
    """Read HOST:PORT, with an IPv6 address in brackets, as a type for argparse.

    [::] means all IPv4 and IPv6 addresses; on a machine without IPv6, all IPv4 addresses.
    """
    host, _, port = text.rpartition(":")
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    if not bare or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise argparse.ArgumentTypeError(f"'{text}' is not HOST:PORT")
    if ":" in bare and bare == host:
        raise argparse.ArgumentTypeError(f"'{text}': put an IPv6 address in brackets, [::1]:7400")
    return "0.0.0.0" if bare == "::" and not _has_ipv6() else bare, int(port)


def _has_ipv6() -> bool:
    """Return whether this machine can open an IPv6 socket."""
    try:
        socket.socket(socket.AF_INET6, socket.SOCK_DGRAM).close()
    except OSError:
        return False
    return True


def show_address(where: Address) -> str:
    """Write an address as HOST:PORT, with an IPv6 address in brackets."""
    host, port = where
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def ipv4_addresses(name: str) -> list[str]:
    """Return the IPv4 addresses of a host name; relay and netem shape only IPv4.

    Raises:
        OSError: If the name has no IPv4 address; the text tells if it has only IPv6 addresses.
    """
    return _addresses(name, socket.AF_INET)


def _addresses(name: str, family: int) -> list[str]:
    try:
        found = socket.getaddrinfo(name, None, family, socket.SOCK_DGRAM)
    except UnicodeError as error:  # an empty label, or one that is too long
        raise OSError(f"not a name: {error}") from error
    except OSError:
        if family != socket.AF_INET or not _only_ipv6(name):
            raise
        raise OSError(
            "it has IPv6 addresses alone, and a link is shaped over IPv4; in a cluster with both "
            "families set ipFamilyPolicy=PreferDualStack"
        ) from None
    return [str(entry[4][0]) for entry in found]


def _only_ipv6(name: str) -> bool:
    try:
        return bool(socket.getaddrinfo(name, None, socket.AF_INET6, socket.SOCK_DGRAM))
    except OSError:
        return False


def resolve_address(flag: str, where: Address, listen: Address | None = None) -> Address:
    """Resolve an address once, before the loop starts: the loop must not wait for a name server.

    Args:
        flag: Flag of the address, for messages.
        where: The address.
        listen: Own address of the process. If it is an IPv6 address, `where` may also be IPv6.

    Raises:
        BadInputError: If the host cannot be resolved; the text names the flag.
    """
    host, port = where
    own = "" if listen is None else listen[0]
    # A socket at [::] reaches both families, one at another address only its own.
    family = 0 if own == "::" else socket.AF_INET6 if ":" in own else socket.AF_INET
    try:
        return _addresses(host, family)[0], port
    except OSError as error:
        wanted = "IPv6" if family == socket.AF_INET6 else "IPv4"
        raise BadInputError(
            f"{flag} {show_address(where)}: {host} cannot be resolved ({error.strerror or error});"
            f" name a host that has an {wanted} address, or the address itself"
        ) from error


def read_size(text: str) -> float:
    """Read a size in the notation of Kubernetes [bytes], as a type for argparse."""
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
    """Write a warning if other machines can send to an address."""
    if not listen[0].startswith("127.") and listen[0] not in LOOPBACK_NAMES:
        print(f"cloudrc: warning: {listen[0]} can be reached from outside", file=sys.stderr)


def open_exporter(options: argparse.Namespace, role: str) -> Exporter | None:
    """Serve the metrics of a process at the address of `--metrics`; None without the flag."""
    if options.metrics is None:
        return None
    from cloudrc.drivers.exporter import Exporter

    warn_if_exposed(options.metrics)
    has_teleop_process = getattr(options, "teleop", None) is not None
    exporter = Exporter(role, missions=not has_teleop_process)
    exporter.serve(options.metrics)
    return exporter


@contextmanager
def listening(flag: str, listen: Address) -> Iterator[None]:
    """Name flag and address in the error if opening a socket inside the block fails."""
    try:
        yield
    except OSError as error:
        raise BadInputError(
            f"{flag} {show_address(listen)}: cannot receive there: {error.strerror or error};"
            " name an address of this machine and a port that is free"
        ) from error


TRACE_MAX = 2 << 20
"""Maximum size of a trace file that the state file of the link container names [bytes]. The
container's own traces come from a ConfigMap, which holds at most 1 MiB."""


class EndRuntime(NamedTuple):
    """All that an end needs at construction and in flight.

    Attributes:
        options: The command's options.
        name: "world" or "cloud".
        exporter: Serves the metrics; None without `--metrics`.
        experiment: The experiment to fly.
        clock: Identity of the machine's clock.
        recorder: Writes the records.
        keys: The tunnel's keys.
        peer: The socket.
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
        """Run an end until it stops; `flies` returns whether the robot is flying.

        For the other arguments see `process.run_end`.
        """
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
            choose=_record_filter(options, flies),
            link=_link_state(options),
            check=_link_monitor(options, self.experiment, uplink=self.name == "cloud"),
            keys=self.keys,
        )


def open_end(options: argparse.Namespace, name: str) -> EndRuntime:
    """Open all that the end "world" or "cloud" needs; an error names the flag."""
    from cloudrc.config.load import fingerprint, load_experiment, read_experiment
    from cloudrc.drivers.machine import clock_id

    exporter, path, clock = open_exporter(options, name), str(options.config), clock_id()
    given = read_experiment(path)
    # Only cloud loads the plug-ins, which fill in their default parameters.
    experiment = load_experiment(path) if name == "cloud" else given
    if exporter is not None:
        exporter.runs(fingerprint(given))
    keys, peer = _open_keys(options), _open_peer(options)
    recorder = _open_recorder(options, name, clock)  # last: it renames an old recording
    return EndRuntime(options, name, exporter, experiment, clock, recorder, keys, peer)


def _open_keys(options: argparse.Namespace) -> KeyFile:
    """Read the keys of an end."""
    import time

    from cloudrc.drivers.keyfile import KeyFile, is_exposed

    keys = KeyFile(options.key, time.monotonic_ns())
    if is_exposed(options.key):
        print(f"cloudrc: warning: everybody can read {options.key}: chmod 600", file=sys.stderr)
    return keys


def _open_peer(options: argparse.Namespace) -> Peer:
    """Bind the socket of an end; the socket sends to the peer or to the address of the route."""
    from cloudrc.drivers.realtime import Peer, Route

    warn_if_exposed(options.listen)
    destination = (
        resolve_address("--peer", options.peer, options.listen)
        if options.route is None
        else Route(options.route)
    )
    if options.route is not None and not options.route.exists():
        print(f"cloudrc: sends nothing until {options.route} exists", file=sys.stderr)
    with listening("--listen", options.listen):
        return Peer.bind(options.listen, destination)


def _open_recorder(options: argparse.Namespace, clock: str, clock_id: bytes) -> Recorder:
    """Make the recorder of an end; without a file the recorder writes to /dev/null."""
    from cloudrc.record.recorder import Recorder
    from cloudrc.record.writer import McapWriter

    path: Path = options.record or Path(os.devnull)
    size_before, size_max = _keep_before(path), None
    if options.record_max:
        room = round(0.9 * options.record_max)
        size_max = max(room - size_before, room // 10)  # both recordings share a volume
    return Recorder(
        path,
        lambda file: McapWriter(file, clock=clock, clock_id=clock_id.hex()),
        size_max=size_max,
    )


def _keep_before(path: Path) -> int:
    """Rename the recording of the previous process to NAME.before.mcap; return its size [bytes].

    A restarted container finds this recording on its volume. The recording shows why the previous
    process ended.
    """
    try:
        size = path.stat().st_size if path.is_file() else 0
        if size:
            path.replace(path.with_name(f"{path.stem}.before{path.suffix}"))
    except OSError:  # the recorder meets the same error and reports it
        return 0
    return size


def _record_filter(
    options: argparse.Namespace, flies: Callable[[], bool]
) -> Callable[[list[Record]], list[Record]]:
    """Return the function that selects the records to write."""
    from cloudrc.drivers.recording import FlightsOnly

    return FlightsOnly(flies) if options.record_flights else list


def _link_state(options: argparse.Namespace) -> Path | None:
    """Return the state file of the link's process; None without flags for the link."""
    link: Path | None = options.link
    route: Path | None = options.route
    return link if link is not None or route is None else route.with_name("link.json")


def _link_monitor(
    options: argparse.Namespace, experiment: ResolvedExperiment, *, uplink: bool
) -> LinkMonitor:
    """Make the monitor of the direction that an end receives; it follows changes of the profile."""
    import json

    from cloudrc.assembly import link_profile
    from cloudrc.config.schema import Profile
    from cloudrc.link.traces import SIZE_MAX
    from cloudrc.link.verify.judge import Flow
    from cloudrc.link.verify.monitor import LinkMonitor
    from cloudrc.tunnel.codec import SIZES, Kind

    def load(values: object) -> tuple[DirectionProfile, DirectionProfile]:
        profile = Profile.model_validate_json(json.dumps(values))
        return link_profile(profile.uplink, file_max), link_profile(profile.downlink, file_max)

    # With a route the link is a container, which is not trusted: its files have a smaller limit.
    file_max = TRACE_MAX if options.link is None else SIZE_MAX
    requested = link_profile(experiment.uplink), link_profile(experiment.downlink)
    kind = Kind.TELEMETRY if uplink else Kind.COMMAND
    flow = Flow(experiment.seed, uplink, kind, SIZES[kind])
    check = LinkMonitor(uplink=uplink, flow=flow)
    check.begin(requested, _link_state(options), load)
    return check
