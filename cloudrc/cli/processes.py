"""Run the processes `cloudrc world`, `cloudrc cloud` and `cloudrc relay` of a local run or a pod.

With `--link DIR`, the relay and `cloudrc link set` exchange files: `link set` writes the files in
the first line of this list, the relay writes the others.

    DIR/profile.json, change.json            requested profile; missing before the first change
    DIR/uplink.json, downlink.json           applied state of the link (`cloudrc/link/state.py`)
    DIR/uplink.released, downlink.released   how late datagrams left the relay, written every 2 s
"""

from __future__ import annotations

import argparse
import json
import os
import re
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from cloudrc.cli.extras import require
from cloudrc.cli.output import print_line
from cloudrc.drivers.process import EndProcess, Feed, StopSignal
from cloudrc.drivers.realtime import Address, Peer, bind, split_address
from cloudrc.errors import BadInputError
from cloudrc.files import warn_if_readable
from cloudrc.link.follow import PROFILE_PERIOD, Loaded, ProfileFile
from cloudrc.link.state import PROFILE_FILE, RELEASED_SUFFIX, StateFile, publish, summary
from cloudrc.records import Counted

if TYPE_CHECKING:
    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.drivers.recording import Recorder
    from cloudrc.link.model import LinkDirection
    from cloudrc.link.profile import DirectionProfile
    from cloudrc.link.relay import Relay
    from cloudrc.link.verify.monitor import LinkMonitor
    from cloudrc.tunnel.end import Identity

TRACE_MAX = 2 << 20
"""Maximum size of a trace file whose name comes from the link container [bytes]. World and cloud do
not trust this container. Real traces come from a ConfigMap, which holds at most 1 MiB."""
PERIOD = 1.0
"""Time between two updates of the relay's counts in the metrics [s]."""
RELEASED_PERIOD = 2.0
"""Time between two updates of the files with the lateness of datagrams [s]."""


class Command(NamedTuple):
    """One command of a module that defines several commands.

    A module with only one command has attributes with the names of these fields.
    """

    arguments: Callable[[argparse.ArgumentParser], None]
    execute: Callable[[argparse.Namespace], int]
    EPILOG: str | None = None


def _add(
    parser: argparse._ActionsContainer, flag: str, kind: str, text: str, *, required: bool = False
) -> None:
    """Declare a flag; `kind`, such as "FILE", names its value; with "" the flag has no value."""
    if not kind:
        parser.add_argument(flag, action="store_true", help=text)
        return
    read: Callable[[str], object] = {"HOST:PORT": read_address, "SIZE": read_size}.get(kind, Path)
    parser.add_argument(flag, type=read, metavar=kind, help=text, required=required)


def process_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the flags that world, cloud, relay and teleop have in common."""
    _add(parser, "--config", "FILE", "experiment file (YAML)", required=True)
    _add(parser, "--feed", "", "write status for a supervisor to stdout (default: events only)")
    _add(parser, "--metrics", "HOST:PORT", "serve metrics and health checks here (default: off)")


def _end_arguments(parser: argparse.ArgumentParser) -> None:
    process_arguments(parser)
    _add(parser, "--record", "FILE", "MCAP file; an existing one becomes NAME.before.mcap")
    _add(parser, "--record-flights", "", "no periodic records while the robot does not fly")
    size = "limit of both recordings, such as 500M or 1Gi; at 90 %% the recording ends"
    _add(parser, "--record-max", "SIZE", size)
    _add(parser, "--listen", "HOST:PORT", "address to receive at", required=True)
    _add(parser, "--link", "FILE", "the link's state, to record it (default: beside --route)")
    _add(parser, "--key", "FILE", "the tunnel's key ('cloudrc key new FILE')", required=True)
    target = parser.add_mutually_exclusive_group(required=True)
    _add(target, "--peer", "HOST:PORT", "address to send to; a name is resolved once")
    _add(target, "--route", "FILE", "file with the numeric HOST:PORT to send to; it may change")


def _cloud_arguments(parser: argparse.ArgumentParser) -> None:
    _end_arguments(parser)
    _add(parser, "--teleop", "DIR", "missions from 'cloudrc teleop --socket DIR' (default: own)")
    _add(parser, "--tap", "FILE", "Unix socket of a console, for samples (default: off)")


def _relay_arguments(parser: argparse.ArgumentParser) -> None:
    process_arguments(parser)
    for end in ("world", "cloud"):
        text = f"address to receive from {end} at"
        _add(parser, f"--{end}-side", "HOST:PORT", text, required=True)
        text = f"address at which {end} receives; a name is resolved once"
        _add(parser, f"--{end}", "HOST:PORT", text, required=True)
    _add(parser, "--link", "DIR", "folder of the link's state and of changes by 'link set'")
    _add(parser, "--fifo", "", "use real-time priority (SCHED_FIFO), if permitted")


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


def show_address(where: Address) -> str:
    """Format an address as HOST:PORT, with an IPv6 address in brackets."""
    host, port = where
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


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


def resolve_address(flag: str, where: Address, listen: Address = ("0.0.0.0", 0)) -> Address:
    """Resolve the host of an address before a control loop starts: the loop must not wait for DNS.

    The result is IPv4 or IPv6, like the address `listen` of this process. If `listen` is [::], the
    result may be either. Raise a BadInputError, which names `flag`, if the host cannot be resolved.
    """
    host, port = where
    family = socket.AF_INET6 if ":" in listen[0] else socket.AF_INET
    try:
        return _addresses(host, 0 if listen[0] == "::" else family)[0], port
    except OSError as error:
        wanted = "IPv6" if family == socket.AF_INET6 else "IPv4"
        raise BadInputError(
            f"{flag} {show_address(where)}: {host} cannot be resolved ({error.strerror or error});"
            f" name a host that has an {wanted} address, or the address itself"
        ) from error


def warn_if_exposed(listen: Address) -> None:
    """Print a warning if other machines can send to the address `listen`."""
    if not listen[0].startswith("127.") and listen[0] not in ("localhost", "::1"):
        print(f"cloudrc: warning: {listen[0]} can be reached from outside", file=sys.stderr)


@contextmanager
def _listening(flag: str, listen: Address) -> Iterator[None]:
    """Warn if other machines can reach `listen`; name `flag` if the block raises an OSError."""
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
    missions = getattr(options, "teleop", None) is None
    exporter = Exporter(role, fingerprint(experiment), missions=missions)
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
    stop: Callable[[], bool] = StopSignal()
    from cloudrc import assembly
    from cloudrc.drivers.tap import Tap
    from cloudrc.drivers.teleop import LastWord, RemoteTeleop, UnixPeer
    from cloudrc.messages import GuardState
    from cloudrc.teleop import wire

    experiment, identity, end = open_end(options, "cloud")
    teleop = None
    if options.teleop:
        paths = options.teleop / "cloud.sock", options.teleop / "teleop.sock"
        teleop = RemoteTeleop(UnixPeer(*paths, wire.encode, wire.decode), time.monotonic_ns())
    cloud = assembly.build_cloud(experiment, identity, time.monotonic_ns, teleop)
    if options.tap:
        end.tap = Tap(options.tap, lambda: cloud.telemetry)

    def flies() -> bool:
        return cloud.guard is GuardState.TRACK

    asked = LastWord(stop, flies) if teleop else stop
    end.run(cloud, lambda: asked() or cloud.mission_over, flies)
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
    link = options.link
    if link is None and options.route is not None:
        link = Path(options.route).with_name("link.json")
    end = EndProcess(
        end=name,
        peer=open_peer(options),
        recorder=open_recorder(options, name, clock),  # renames an old recording
        keys=keys,
        feed=feed,
        exporter=exporter,
        flights_only=options.record_flights,
        link=link,
        check=link_monitor(experiment, link, uplink=name == "cloud", trusted=bool(options.link)),
    )
    return experiment, Identity(clock, os.urandom(16), keys.ring), end


def open_peer(options: argparse.Namespace) -> Peer:
    """Bind the socket of world or cloud.

    The peer's address is the value of `--peer`, or the content of the file `--route`.
    """
    target: Address | Path | None = options.route
    if target is None:
        target = resolve_address("--peer", options.peer, options.listen)
    elif not options.route.exists():
        print(f"cloudrc: sends nothing until {target} exists", file=sys.stderr)
    with _listening("--listen", options.listen):
        return Peer.bind(options.listen, target)


def open_recorder(options: argparse.Namespace, clock: str, clock_id: bytes) -> Recorder:
    """Make the recorder of world or cloud; without `--record` the recorder writes to /dev/null.

    The recording of a previous process is kept as NAME.before.mcap, because it may show why that
    process ended. `--record-max` limits the size of both recordings together. `clock` is "world" or
    "cloud", the clock of the stamps; `clock_id` identifies this machine's monotonic clock.
    """
    require("a recording", ("record",))
    from cloudrc.drivers.recording import Recorder
    from cloudrc.record.writer import McapWriter

    path: Path = options.record or Path(os.devnull)
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
            file, clock=clock, clock_id=clock_id.hex(), wall_offset_ns=offset_ns, index=False
        ),
        size_max=size_max,
    )


def link_monitor(
    experiment: ResolvedExperiment, state: Path | None, *, uplink: bool, trusted: bool
) -> LinkMonitor:
    """Make the monitor that compares the received datagrams with the link profile.

    `uplink` is True in cloud, False in world. In flight, the monitor reads changes of the profile
    from the link's file `state`; with None, the experiment's profile stays in force. If the link is
    not `trusted`, the monitor refuses trace files that are larger than TRACE_MAX.
    """
    from cloudrc.assembly import link_profile
    from cloudrc.config.schema import Profile
    from cloudrc.link.traces import SIZE_MAX
    from cloudrc.link.verify.judge import Flow
    from cloudrc.link.verify.monitor import LinkMonitor
    from cloudrc.messages import plan_length
    from cloudrc.tunnel.codec import COMMAND_SIZES, SIZES, Kind

    file_max = SIZE_MAX if trusted else TRACE_MAX

    def load(values: object) -> tuple[DirectionProfile, DirectionProfile]:
        profile = Profile.model_validate_json(json.dumps(values))
        return link_profile(profile.uplink, file_max), link_profile(profile.downlink, file_max)

    kind = Kind.TELEMETRY if uplink else Kind.COMMAND
    rate = experiment.world.odometry_rate_hz if uplink else experiment.cloud.command_rate_hz
    size = SIZES[kind] if uplink else COMMAND_SIZES[plan_length(experiment.cloud.plan_s)]
    flow = Flow(experiment.seed, uplink, kind, size)
    computes = experiment.cloud.compute_ms > 0
    check = LinkMonitor(uplink=uplink, flow=flow, period=1.0 / rate, computes=computes)
    requested = link_profile(experiment.uplink), link_profile(experiment.downlink)
    check.begin(requested, state, load)
    return check


def _run_relay(options: argparse.Namespace) -> int:
    stop = StopSignal()
    from cloudrc import assembly
    from cloudrc.config.load import read_experiment
    from cloudrc.link.relay import ask_for_fifo, settle

    experiment = read_experiment(str(options.config))
    exporter = open_exporter(options, "link", experiment)
    links = dict(zip(("uplink", "downlink"), assembly.build_links(experiment), strict=True))
    ways = {"uplink": experiment.uplink, "downlink": experiment.downlink}
    values = {way: d.model_dump(mode="json", exclude_defaults=True) for way, d in ways.items()}
    profiles = {way: Loaded(assembly.link_profile(d), values) for way, d in ways.items()}
    settle()
    if options.fifo:
        refused = ask_for_fifo()
        _log(f"runs at normal priority: {refused}" if refused else "runs under SCHED_FIFO")
    relay = open_relay(options, *links.values())
    if exporter is not None:
        for way, loaded in profiles.items():
            exporter.shaped("relay", way, "relay")
            exporter.asked(way, summary(loaded.direction)["delay"] or 0.0)
        exporter.ready(True)
    feed, control, count_due = Feed.on_stdout(watched=options.feed), None, 0.0
    if options.link:
        asked = exporter.asked if exporter else lambda way, delay: None
        control = RelayControl(options.link, links, profiles, asked, relay)
        threading.Thread(target=control.follow, name="link control", daemon=True).start()

    def over() -> bool:
        """Apply changes of the link; export the counts, if due; return whether to stop."""
        nonlocal count_due
        if control is not None:
            control.swap()
        if exporter is not None and time.monotonic() >= count_due:
            count_due = time.monotonic() + PERIOD
            exporter.see([Counted(0, "link", name, n) for name, n in relay.counts().items()])
        return stop()

    feed.ready()
    relay.run(feed.alive_while(over))
    _log(", ".join(f"{name} {count:g}" for name, count in relay.counts().items()))
    return 0


def open_relay(
    options: argparse.Namespace, uplink: LinkDirection, downlink: LinkDirection
) -> Relay:
    """Open the relay's sockets at the addresses of the command line; return the relay.

    Raise a BadInputError if an address cannot be used.
    """
    from cloudrc.link.relay import Lane, Relay
    from cloudrc.tunnel.codec import peek

    with ExitStack() as opened:
        sides = []
        for end in ("world", "cloud"):
            peer = resolve_address(f"--{end}", getattr(options, end))
            listen = getattr(options, f"{end}_side")
            with _listening(f"--{end}-side", listen):
                sides.append(opened.enter_context(bind(listen)))
            try:
                sides[-1].connect(peer)  # takes datagrams from this address alone
            except OSError as error:
                raise BadInputError(
                    f"the relay cannot reach --{end} from --{end}-side ({error.strerror or error});"
                    " give it an address that reaches its end"
                ) from error
        opened.pop_all()  # they stay open until this process ends
    world, cloud = sides
    lanes = {
        "uplink": Lane(world, cloud.send, uplink, peek),
        "downlink": Lane(cloud, world.send, downlink, peek),
    }
    return Relay(lanes)


class RelayControl:
    """Applies the changes of `cloudrc link set` to a relay, and publishes the relay's state.

    A separate thread reads the files. The relay's loop replaces the profiles.
    """

    def __init__(
        self,
        folder: Path,
        links: Mapping[str, LinkDirection],
        first: Mapping[str, Loaded],
        asked: Callable[[str, float], object],
        relay: Relay,
    ) -> None:
        """Publish the initial state of both directions in `folder`, which is created if missing.

        `links` and `first` contain the link model and the first profile of each direction, by the
        name "uplink" or "downlink". `asked` is called with this name and the requested mean delay
        [s], now and after each change.
        """
        from cloudrc.cli.link_run import make_profile_loader

        self._folder, self._links, self._asked, self._relay = folder, links, asked, relay
        folder.mkdir(exist_ok=True)
        file, self._released_at = folder / PROFILE_FILE, 0.0
        self._files = {way: ProfileFile(file, make_profile_loader(way), _log) for way in links}
        self._states = {way: StateFile(folder / f"{way}.json", "relay", way) for way in links}
        self._requested, self._applied, self._published = dict(first), dict(first), dict(first)
        self._applied_ns = dict.fromkeys(first, time.monotonic_ns())
        for way, loaded in first.items():
            self._publish(way, loaded)

    def swap(self) -> None:
        """Apply the requested profiles; the relay's loop calls this between two datagrams."""
        for way, loaded in self._requested.items():
            if loaded is not self._applied[way]:
                self._relay.take_in()
                self._links[way].replace_profile(loaded.direction, restart=loaded.change.restart)
                self._applied_ns[way], self._applied[way] = time.monotonic_ns(), loaded

    def follow(self) -> None:
        """Call `look` periodically; never return, so run this method in a thread of its own."""
        while True:
            self.look()
            time.sleep(PROFILE_PERIOD)

    def look(self) -> None:
        """Read the requested profiles; publish applied profiles and the lateness of the datagrams.

        `follow` calls this in its own thread, because the relay's loop must not wait for a disk.
        """
        for way, file in self._files.items():
            self._requested[way] = file.poll() or self._requested[way]
            if (loaded := self._applied[way]) is not self._published[way]:
                with suppress(OSError):  # such as a full disk: the next call tries again
                    self._publish(way, loaded)
                    self._published[way] = loaded
        if time.monotonic() - self._released_at >= RELEASED_PERIOD:
            self._released_at = time.monotonic()
            for way in self._links:
                if released := self._relay.lanes[way].released():
                    with suppress(OSError):
                        publish(self._folder / f"{way}{RELEASED_SUFFIX}", json.dumps(released))

    def _publish(self, way: str, loaded: Loaded) -> None:
        now_ns, states = self._applied_ns[way], self._states[way]
        # None: the time line of the first profile starts with the first datagram.
        origin_ns = now_ns if states.state and loaded.change.restart else None
        state = states.next(loaded, "relay", "local mode", now_ns, origin_ns)
        self._asked(way, state.asked["delay"] or 0.0)
        states.publish(state)


def _log(line: str) -> None:
    print_line(f"cloudrc relay: {line}", sys.stderr)


world = Command(_end_arguments, _run_world)
cloud = Command(_cloud_arguments, _run_cloud)
relay = Command(_relay_arguments, _run_relay)
