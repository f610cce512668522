"""Run the processes `cloudrc world` and `cloudrc cloud` of a local run or a pod."""

from __future__ import annotations

import argparse
import os
import re
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cloudrc.cli.output import print_line
from cloudrc.drivers.process import EndProcess, Feed, GracefulStop, StopSignal
from cloudrc.drivers.realtime import Address, Peer, bind, show_address, split_address
from cloudrc.errors import BadInputError
from cloudrc.files import warn_if_readable
from cloudrc.link.state import STATE_FILE
from cloudrc.runs.requirements import require

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.drivers.recording import Recorder
    from cloudrc.link.verify.monitor import LinkMonitor
    from cloudrc.tunnel.end import Identity

IN_POD = "KUBERNETES_SERVICE_HOST"
"""Environment variable that Kubernetes sets in each container of a pod."""

TRACE_MAX = 2 << 20
"""Maximum size of a trace file whose name comes from the link process [bytes]. World and cloud do
not trust this process. In a cluster, traces come from a ConfigMap, which holds at most 1 MiB."""

FORWARD_LIMIT_NS = 800_000_000
"""Longest time for which cloud, when asked to end, still forwards teleop's request to hold [ns]. A
process has 1.5 s to end."""


class Command(NamedTuple):
    """One command of a module that defines several commands.

    A module with only one command is used in place of a `Command`: it defines the same names.
    """

    arguments: Callable[[argparse.ArgumentParser], None]
    execute: Callable[[argparse.Namespace], int]
    EPILOG: str | None = None


def _add(
    parser: argparse.ArgumentParser, flag: str, kind: str, text: str, *, required: bool = False
) -> None:
    """Declare a flag; `kind`, such as "FILE", names its value; with "" the flag has no value."""
    if not kind:
        parser.add_argument(flag, action="store_true", help=text)
        return
    read: Callable[[str], object] = {"HOST:PORT": read_address, "SIZE": read_size}.get(kind, Path)
    parser.add_argument(flag, type=read, metavar=kind, help=text, required=required)


def process_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags that world, cloud, link and teleop have in common."""
    _add(parser, "--config", "FILE", "experiment file (YAML)", required=True)
    _add(parser, "--feed", "", "write status for a supervisor to stdout (default: events only)")
    _add(parser, "--metrics", "HOST:PORT", "serve metrics and health checks here (default: off)")


def _end_arguments(parser: argparse.ArgumentParser) -> None:
    process_arguments(parser)
    file = "MCAP file to record to; an existing one becomes NAME.before.mcap"
    _add(parser, "--record", "FILE", file, required=True)
    _add(parser, "--record-flights", "", "no periodic records while the robot does not fly")
    size = "limit of both recordings, such as 500M or 1Gi; at 90 %% the recording ends"
    _add(parser, "--record-max", "SIZE", size)
    _add(parser, "--listen", "HOST:PORT", "address to receive at", required=True)
    _add(parser, "--key", "FILE", "the tunnel's key ('cloudrc key new FILE')", required=True)
    route = "the link's file with the address to send to; the link's state is beside it"
    _add(parser, "--route", "FILE", route, required=True)


def _cloud_arguments(parser: argparse.ArgumentParser) -> None:
    _end_arguments(parser)
    text = "folder of the sockets of 'cloudrc teleop --socket DIR'"
    _add(parser, "--teleop", "DIR", text, required=True)


def read_address(text: str) -> Address:
    """Parse HOST:PORT for argparse; an IPv6 address is in brackets.

    The host [::] means all addresses of this machine; without IPv6 it becomes 0.0.0.0.
    """
    try:
        host, port = split_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return "0.0.0.0" if host == "::" and not _has_ipv6() else host, port


def _has_ipv6() -> bool:
    try:
        socket.socket(socket.AF_INET6, socket.SOCK_DGRAM).close()
    except OSError:
        return False
    return True


def read_size(text: str) -> float:
    """Parse a size in the notation of Kubernetes, such as 500M, for argparse; return bytes."""
    found = re.fullmatch(r"([0-9]+(?:\.[0-9]+)?)([kKMGT]?)(i?)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"'{text}' is not a size such as 500M or 1Gi")
    number, unit, binary = found.groups()
    power = " KMGT".index(unit.upper() or " ")
    return float(number) * (1024.0 if binary else 1000.0) ** power


def ipv4_addresses(name: str) -> list[str]:
    """Return the IPv4 addresses of a host name; relay and netem shape IPv4 only.

    Raise an OSError if there is none; its text tells whether the name has IPv6 addresses.
    """
    try:
        return _addresses(name, socket.AF_INET)
    except OSError as error:
        with suppress(OSError):
            _addresses(name, socket.AF_INET6)
            error.strerror = (
                "it has only IPv6 addresses, but a link needs IPv4; in a cluster with both "
                "families set ipFamilyPolicy=PreferDualStack"
            )
        raise


def _addresses(name: str, family: int) -> list[str]:
    try:
        found = socket.getaddrinfo(name, None, family, socket.SOCK_DGRAM)
    except UnicodeError as error:  # an empty label, or one that is too long
        raise OSError(f"not a name: {error}") from error
    return [str(entry[4][0]) for entry in found]


def warn_if_exposed(listen: Address) -> None:
    """Print a warning if other machines can send to `listen`; in a pod, that is the purpose."""
    if IN_POD in os.environ:
        return
    if not listen[0].startswith("127.") and listen[0] not in ("localhost", "::1"):
        print(f"cloudrc: warning: {listen[0]} can be reached from outside", file=sys.stderr)


@contextmanager
def listening(flag: str, listen: Address) -> Iterator[None]:
    """Warn if other machines can reach `listen`; convert an OSError to an error about `flag`."""
    warn_if_exposed(listen)
    try:
        yield
    except OSError as error:
        raise BadInputError(
            f"{flag} {show_address(listen)}: cannot receive there: {error.strerror or error};"
            " name an address of this machine and a port that is free"
        ) from error


def open_exporter(
    options: argparse.Namespace, role: str, experiment: ResolvedExperiment
) -> Exporter | None:
    """Serve the metrics of this process at the address of `--metrics`; without it, return None."""
    if options.metrics is None:
        return None
    from cloudrc.config.load import fingerprint
    from cloudrc.drivers.exporter import Exporter

    warn_if_exposed(options.metrics)
    exporter = Exporter(role, fingerprint(experiment))
    exporter.serve(options.metrics)
    return exporter


def _run_world(options: argparse.Namespace) -> int:
    stop = StopSignal()
    from cloudrc import assembly

    experiment, identity, end = open_end(options, "world")
    world = assembly.build_world(experiment, identity, time.monotonic_ns)
    end.run(world, stop, lambda: world.robot.guard.armed, lambda: world.slip_ns)
    return 0


def _run_cloud(options: argparse.Namespace) -> int:
    stop = StopSignal()
    from cloudrc import assembly
    from cloudrc.drivers.teleop import RemoteTeleop, UnixPeer
    from cloudrc.messages import GuardState
    from cloudrc.plugins import apart

    experiment, identity, end = open_end(options, "cloud")
    paths = options.teleop / "cloud.sock", options.teleop / "teleop.sock"
    with closing(UnixPeer(*paths)) as peer:
        teleop = RemoteTeleop(peer, time.monotonic_ns())
        cloud = assembly.build_cloud(experiment, identity, teleop, time.monotonic_ns)

        def flies() -> bool:
            return cloud.guard is GuardState.TRACK

        ends = GracefulStop(stop, lambda: not flies(), FORWARD_LIMIT_NS)
        with apart():
            end.run(cloud, ends, flies)
    return 0


def open_end(
    options: argparse.Namespace, name: str
) -> tuple[ResolvedExperiment, Identity, EndProcess]:
    """Open the files and sockets of world or cloud; `name` is "world" or "cloud".

    Return the experiment, the identity of the process in the tunnel, and the `EndProcess` to run.
    """
    from cloudrc.config.load import load_experiment, read_experiment
    from cloudrc.drivers.keyfile import KeyFile
    from cloudrc.drivers.machine import clock_id
    from cloudrc.tunnel.end import Identity

    feed = Feed.on_stdout(watched=options.feed)  # before plug-ins are loaded: they may print
    path, clock, key = str(options.config), clock_id(), options.key
    given = read_experiment(path)
    exporter = open_exporter(options, name, given)
    # Only cloud loads the plug-ins, which fill in their default parameters.
    experiment = load_experiment(path) if name == "cloud" else given
    keys = KeyFile(key, time.monotonic_ns())
    warn_if_readable(key, lambda text: print_line(f"cloudrc: {text}", sys.stderr))
    link = options.route.with_name(STATE_FILE)
    with listening("--listen", options.listen):
        peer = Peer(bind(options.listen), options.route)
    end = EndProcess(
        end=name,
        peer=peer,
        recorder=open_recorder(options, name, clock),  # renames an old recording
        keys=keys,
        feed=feed,
        exporter=exporter,
        flights_only=options.record_flights,
        link=link,
        check=link_monitor(experiment, uplink=name == "cloud", trusted=options.feed),
    )
    return experiment, Identity(clock, os.urandom(16), keys.ring), end


def open_recorder(options: argparse.Namespace, clock: str, clock_id: bytes) -> Recorder:
    """Make the recorder of world or cloud, which writes to the file of `--record`.

    The recording of a previous process is kept as NAME.before.mcap, because it may show why that
    process ended. `--record-max` limits the size of both recordings together. `clock` is "world" or
    "cloud", the clock of the stamps; `clock_id` identifies this machine's monotonic clock.
    """
    require("a recording", ("record",))
    from cloudrc.drivers.recording import Recorder
    from cloudrc.record.writer import McapWriter
    from cloudrc.source import code_hash

    path: Path = options.record
    kept, size_max = 0, None
    with suppress(OSError):  # the recorder will meet the same error and report it
        if path.is_file() and (kept := path.stat().st_size):
            path.replace(path.with_name(f"{path.stem}.before{path.suffix}"))
    if options.record_max:
        room = round(0.9 * options.record_max)
        size_max = max(room - kept, room // 10)
    offset_ns = time.time_ns() - time.monotonic_ns()
    return Recorder(
        path,
        lambda file: McapWriter(
            file,
            clock=clock,
            clock_id=clock_id.hex(),
            wall_offset_ns=offset_ns,
            code=code_hash(),
            index=False,
        ),
        size_max=size_max,
    )


def link_monitor(experiment: ResolvedExperiment, *, uplink: bool, trusted: bool) -> LinkMonitor:
    """Make the monitor that compares the received datagrams with the link profile.

    `uplink` is True in cloud, False in world. If the link is not `trusted`, as in a pod, the
    monitor refuses trace files that are larger than TRACE_MAX.
    """
    from cloudrc.link.traces import SIZE_MAX, link_profile
    from cloudrc.link.verify.judge import Flow
    from cloudrc.link.verify.monitor import LinkMonitor
    from cloudrc.messages import plan_length
    from cloudrc.tunnel.codec import COMMAND_SIZES, SIZES, Kind

    kind = Kind.TELEMETRY if uplink else Kind.COMMAND
    rate = experiment.world.odometry_rate_hz if uplink else experiment.cloud.command_rate_hz
    size = SIZES[kind] if uplink else COMMAND_SIZES[plan_length(experiment.cloud.plan_s)]
    flow = Flow(experiment.seed, uplink, kind, size)
    computes, file_max = experiment.cloud.compute_ms > 0, SIZE_MAX if trusted else TRACE_MAX
    check = LinkMonitor(uplink, flow, period=1.0 / rate, computes=computes, file_max=file_max)
    check.begin((link_profile(experiment.uplink), link_profile(experiment.downlink)))
    return check


world = Command(_end_arguments, _run_world)
cloud = Command(_cloud_arguments, _run_cloud)
