"""Run `cloudrc link verify`: compare a link with its profile, by probes or in flight.

By default the command starts a link on this machine and sends probes. In a cluster it sends no
probes: world and cloud each compare the datagrams that they receive with the profile. They serve
their verdicts at /link.json on their metrics ports. The link containers serve the state of their
shapers at the same path.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import json
import os
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import inf, nan
from pathlib import Path
from typing import Any, TypeAlias

from cloudrc.cli.cluster_flags import flown_release
from cloudrc.cli.link_run import run_tool
from cloudrc.cli.output import escape, paint, print_result, table
from cloudrc.cli.processes import show_address
from cloudrc.cluster.client import end_process
from cloudrc.cluster.pods import METRICS, NO_PROXY
from cloudrc.config import shipped
from cloudrc.config.load import ResolvedExperiment, dump, read_experiment
from cloudrc.config.schema import Experiment, Profile
from cloudrc.drivers.local import ROUTE_FILE, link_words, start_process
from cloudrc.drivers.realtime import bind, free_ports, split_address
from cloudrc.errors import (
    BadInputError,
    CloudrcError,
    InvalidRunError,
    MissingPrerequisiteError,
    TimedOutError,
)
from cloudrc.link.follow import prepare_link
from cloudrc.link.model import Stream
from cloudrc.link.netem import check, find_netems
from cloudrc.link.state import STATE_FILE, from_text
from cloudrc.link.traces import link_profile
from cloudrc.link.verify import DEFAULT
from cloudrc.link.verify.causes import (
    Findings,
    find_causes,
    in_unit,
    read_evidence,
    read_metrics,
)
from cloudrc.link.verify.judge import Flow, Judgement, Measurement, look_twice, verdict_of
from cloudrc.link.verify.probe import PROBE, ProbeEnd, plan_probes, send_probes
from cloudrc.runs.interrupts import interrupt_on_signals
from cloudrc.tunnel.codec import SIZES, Kind

RELEASE_TIMEOUT = 270.0  # default time limit for the verdict on a release [s]
START_LIMIT = 90.0  # for the processes of both directions to start, on a slow disk [s]
COUNTS_WAIT = 1.3  # after the last probe: processes update their counts once a second [s]
POLL_PERIOD, HTTP_TIMEOUT = 2.0, 3.0  # between requests to a release; limit of a request [s]
PORTS = METRICS["world"]["world"], METRICS["world"]["link"]
LOOPBACK, DEVICE = "127.0.0.1", "tunnel"
HOSTS = {"uplink": "10.79.7.1", "downlink": "10.79.7.2"}  # senders, with netem
WAYS = {
    "uplink": ("world", "cloud", Kind.TELEMETRY),
    "downlink": ("cloud", "world", Kind.COMMAND),
}
"""Direction -> sender, receiver, and the kind of datagram that the sender sends."""
KEYS = ("asked", "measured", "low", "high")  # values of a row, in the order of the table's columns
NOT_JUDGED = "NOT JUDGED"  # in a note about a quantity that could not be verified
VERDICTS = {
    "off": ("not believed", "red", "does not match its profile"),
    "open": ("undecided", "yellow", "needs more --seconds, or cannot be judged: see the notes"),
    "ok": ("believed", "green", "matches its profile"),
}
"""Worst verdict on any quantity of the link -> verdict on the whole link, with colour and text."""
_CLONE_NEWNET = 0x40000000  # linux include/uapi/linux/sched.h

Report: TypeAlias = dict[str, Any]
Pods: TypeAlias = Mapping[str, Sequence[str]]
"""World or cloud -> two URLs: the metrics port of the process, and that of its link container."""


def execute(options: argparse.Namespace) -> int:
    """Measure the link and print the verdict; return 0 if the link matches its profile, else 1."""
    if options.seconds is not None and not 1.0 <= options.seconds <= 3600.0:
        raise BadInputError(f"--seconds {options.seconds:g}: give a number from 1 to 3600")
    interrupt_on_signals()  # on a signal, remove namespaces and processes
    if options.ends or options.mode == "cluster":
        with _pods(options) as pods:
            limit = options.seconds or RELEASE_TIMEOUT
            report = verify_release(options.release or "cloudrc", pods, limit)
    else:
        experiment = find_experiment(options.target, options.settings)
        report = verify(options.target, experiment, options.shaper, options.seconds)
    print_result(options.output, report, as_text(report))
    return 0 if report["verdict"] == "believed" else 1


def find_experiment(target: str, settings: list[str]) -> ResolvedExperiment:
    """Read the experiment `target`; for a link profile, use it in the default experiment."""
    experiments, profiles = shipped.names("experiment"), shipped.names("profile")
    is_profile = target not in experiments
    if shipped.is_path(target):
        keys = set(shipped.read("profile", target, Path.cwd()).tree)
        is_profile = keys.isdisjoint(Experiment.model_fields.keys() - Profile.model_fields.keys())
        target = str(Path.cwd() / target)
    elif target not in (*experiments, *profiles):
        names = ", ".join([*profiles, *experiments])
        raise BadInputError(f"no profile or experiment named '{target}'; available: {names}")
    if not is_profile:
        return read_experiment(target, settings)
    return read_experiment(DEFAULT, [f"link.profile={target}", *settings])


@dataclass(slots=True)
class Way:
    """One direction of a link under test, with the socket of its probes and its shaper process."""

    own: socket.socket  # sends the probes of this direction, receives those of the other
    ports: tuple[int, int]  # port at which a relay receives, and metrics port
    namespace: str  # network namespace; "" for the namespace of this process
    peer: tuple[str, int] = ("", 0)  # address of the other direction's socket
    folder: Path = Path()
    process: subprocess.Popen[bytes] | None = None


def verify(
    title: str, experiment: ResolvedExperiment, shaper: str, seconds: float | None
) -> Report:
    """Send probes over a link for `seconds` [s] (None: as long as needed), and judge the link.

    If a measured quantity gets the verdict "off", repeat the measurement once.
    """
    plans, found = make_plans(experiment, seconds, shaper), dict[str, Findings]()
    longest = max(plan.sent[-1] for plan in plans.values())
    for look in ("sending probes", "measuring again what is off"):
        with run_link(experiment, shaper) as ways:
            print(f"{look} for {longest:.0f} s", file=sys.stderr, flush=True)
            now = probe_link(ways, plans)
        rows = {way: look_twice(found.get(way, now[way]).rows, now[way].rows) for way in now}
        found = {way: now[way]._replace(rows=rows[way]) for way in now}
        if "off" not in {verdict_of(one.rows) for one in found.values()}:
            break
    return make_report(title, found)


def make_plans(
    experiment: ResolvedExperiment, seconds: float | None, shaper: str
) -> dict[str, Measurement]:
    """Plan probes in both directions for `seconds` [s] (None: as long as needed).

    Raises:
        BadInputError: If netem cannot realise the profile; the text names the direction.
    """
    plans, netem = {}, shaper == "netem"
    for way, (_, _, kind) in WAYS.items():
        flow = Flow(experiment.seed, way == "uplink", PROBE, SIZES[kind])
        profile = link_profile(getattr(experiment, way))
        try:
            if netem:
                check(profile)
        except BadInputError as error:
            raise BadInputError(f"{way}: {error}") from None
        plans[way] = plan_probes(profile, flow, seconds, drawn=netem)
    return plans


def measure(ways: Mapping[str, Way], plans: Mapping[str, Measurement]) -> dict[str, Stream]:
    """Send all probes over a running link; return what the probes measured in each direction."""
    since_wall_ns, ends = time.time_ns() - time.monotonic_ns(), []
    for name, way in ways.items():
        route = split_address((way.folder / ROUTE_FILE).read_text())
        origin_ns = from_text((way.folder / STATE_FILE).read_text()).origin_ns + since_wall_ns
        ends.append(ProbeEnd(way.own, route, plans[name], origin_ns))
    return dict(zip(ways, send_probes(ends), strict=True))


def probe_link(ways: Mapping[str, Way], plans: Mapping[str, Measurement]) -> dict[str, Findings]:
    """Send all probes over a running link, and judge it; return direction -> findings."""
    streams, found = measure(ways, plans), {}
    time.sleep(COUNTS_WAIT)
    for name, way in ways.items():
        page = json.loads((way.folder / STATE_FILE).read_text())
        with inside(way.namespace):  # the process of the link may be stopped: ask the kernel
            page |= find_netems(run_tool, way.peer[0])
            metrics = read_metrics(fetch(f"http://{LOOPBACK}:{way.ports[1]}/metrics"))
        plan, count = plans[name], len(streams[name].sent)
        probes = f"{count} probes of {plan.flow.size} bytes"
        known = read_evidence(page, metrics, count)
        found[name] = Findings(plan.judge(streams[name]), known, probes)
    return found


@contextlib.contextmanager
def run_link(experiment: ResolvedExperiment, shaper: str) -> Iterator[dict[str, Way]]:
    """Run both directions of a link during a `with` block; yield a mapping: direction -> `Way`.

    The relay runs on loopback; netem runs in two network namespaces.

    Raises:
        CloudrcError: If a process of the link ends early or starts too slowly.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cloudrc-verify-")))
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        prepare_link(folder, experiment)
        names, hosts = dict.fromkeys(WAYS, ""), dict.fromkeys(WAYS, LOOPBACK)
        if shaper == "netem":
            names, hosts = stack.enter_context(_namespaces()), HOSTS
        ways = {}
        for name in WAYS:
            with inside(names[name]):
                own = stack.enter_context(bind((hosts[name], 0)))
                listen, pages = free_ports(2)
            ways[name] = Way(own, (listen, pages), names[name], folder=folder / name)
        for (name, way), other in zip(ways.items(), reversed(ways.values()), strict=True):
            way.peer = other.own.getsockname()
            way.process = _start(name, way, shaper)
            stack.callback(end_process, way.process)
        deadline = time.monotonic() + START_LIMIT
        while not all((way.folder / ROUTE_FILE).exists() for way in ways.values()):
            for name, way in ways.items():
                if way.process and (code := way.process.poll()) is not None:
                    raise _ended(name, code, (way.folder / "log").read_text(errors="replace"))
            if time.monotonic() > deadline:
                raise TimedOutError(f"the link was not up within {START_LIMIT:g} s; try again")
            time.sleep(0.02)
        yield ways


def _start(name: str, way: Way, shaper: str) -> subprocess.Popen[bytes]:
    relay, pages = (f"{LOOPBACK}:{port}" for port in way.ports)
    options: dict[str, object] = {"listen": relay, "metrics": pages, "mode": shaper}
    options |= {"config": way.folder.parent / "config.yaml", "peer": show_address(way.peer)}
    words = link_words(way.folder.parent, name)
    with (way.folder / "log").open("wb") as log, inside(way.namespace):
        return start_process(words, options, log, log)


def _ended(name: str, code: int, log: str) -> CloudrcError:
    last = (log.strip().splitlines() or ["it left no message"])[-1]
    text = f"the {name} is not shaped: {last.removeprefix('cloudrc: error: ')}"
    known = {one.exit_code: one for one in (BadInputError, MissingPrerequisiteError, TimedOutError)}
    if code in known:
        return known[code](text)
    return InvalidRunError(f"{text} (exit code {code})")


@contextlib.contextmanager
def _namespaces() -> Iterator[dict[str, str]]:
    """Make two network namespaces with a veth pair between them; yield direction -> namespace."""
    if os.geteuid() != 0:
        raise MissingPrerequisiteError(
            "netem is verified between two network namespaces, which needs root; run this as root,"
            " or verify the relay (--shaper relay)"
        )
    names = {way: f"cloudrc-{way}-{os.getpid()}" for way in HOSTS}
    near, far = names.values()
    with contextlib.ExitStack() as stack:
        for name in names.values():
            run_tool(("ip", "netns", "add", name))
            stack.callback(run_tool, ("ip", "netns", "del", name))
        run_tool(
            ("ip", "-n", near, "link", "add", DEVICE, "type", "veth", "peer", DEVICE, "netns", far)
        )
        for way, name in names.items():
            run_tool(("ip", "-n", name, "addr", "add", f"{HOSTS[way]}/24", "dev", DEVICE))
            for device in ("lo", DEVICE):
                run_tool(("ip", "-n", name, "link", "set", device, "up"))
        yield names


@contextlib.contextmanager
def inside(namespace: str) -> Iterator[None]:
    """Move this thread into a network namespace while the block runs; "" changes nothing.

    Sockets and processes that the block makes stay in the namespace after the block.
    """
    if not namespace:
        yield
        return
    library = ctypes.CDLL(None, use_errno=True)  # os.setns exists from Python 3.12 only
    with open("/proc/thread-self/ns/net") as home, open(f"/run/netns/{namespace}") as target:
        if library.setns(target.fileno(), _CLONE_NEWNET):
            raise MissingPrerequisiteError(f"cannot enter {namespace}; use --shaper relay")
        try:
            yield
        finally:
            library.setns(home.fileno(), _CLONE_NEWNET)


@contextlib.contextmanager
def _pods(options: argparse.Namespace) -> Iterator[Pods]:
    """Yield the URLs of both pods' metrics: on the hosts in `--ends`, or on forwarded ports."""
    hosts = options.ends.split(",") if options.ends else []
    if hosts and (len(hosts) != 2 or not all(hosts)):
        raise BadInputError(f"--ends {options.ends}: give two hosts, WORLD,CLOUD")
    if hosts:
        pairs = zip(("world", "cloud"), hosts, strict=True)
        yield {end: [f"http://{host}:{port}" for port in PORTS] for end, host in pairs}
        return
    from cloudrc.cluster.pods import find_pod, forwarded

    pods, release = {}, flown_release(options)
    with contextlib.ExitStack() as stack:
        for end in ("world", "cloud"):
            pod = find_pod(release, end).metadata.name
            local = stack.enter_context(forwarded(release, pod, PORTS))
            pods[end] = [f"http://{LOOPBACK}:{local[port]}" for port in PORTS]
        yield pods


def verify_release(title: str, pods: Pods, limit: float) -> Report:
    """Fetch the verdicts on both directions of a release's link, and report them.

    World judges the downlink, cloud the uplink. Wait at most `limit` [s] for both verdicts.

    Raises:
        TimedOutError: If world or cloud does not answer in time.
    """
    deadline, seen = time.monotonic() + limit, dict[str, Any]()
    while True:
        time.sleep(POLL_PERIOD)
        for way, (_, receiver, _) in WAYS.items():
            if page := fetch(f"{pods[receiver][0]}/link.json"):
                seen[way] = json.loads(page)
        decided = {found["verdict"] for found in seen.values()} <= {"ok", "off"}
        if (decided and len(seen) == len(WAYS)) or time.monotonic() >= deadline:
            break
    if silent := [receiver for way, (_, receiver, _) in WAYS.items() if way not in seen]:
        text = f"{' and '.join(silent)} did not answer within {limit:g} s: are the pods ready?"
        raise TimedOutError(text)
    return make_report(title, {way: _findings(seen[way], pods[WAYS[way][0]][1]) for way in WAYS})


def fetch(url: str) -> str:
    """Fetch a page, without a proxy; return "" if the server does not answer."""
    try:
        with NO_PROXY.open(url, timeout=HTTP_TIMEOUT) as page:
            return str(page.read().decode())
    except OSError:
        return ""


def _findings(found: Mapping[str, Any], link: str) -> Findings:
    """Combine the receiver's verdict `found` with the link container's report at the URL `link`."""
    page, rows = json.loads(fetch(f"{link}/link.json") or "{}"), []
    for one in found["rows"]:
        asked, measured, low, high = (float(one.get(key, nan)) for key in KEYS)
        rows.append(Judgement(one["quantity"], asked, measured, low, high, one["verdict"]))
    count = max((one["datagrams"] for one in found["rows"]), default=0)
    known = read_evidence(page, read_metrics(fetch(f"{link}/metrics")))
    return Findings(rows, known, f"{count} of the tunnel's own datagrams")


def _notes(way: str, rows: Sequence[Judgement]) -> Iterator[str]:
    judged = {row.name for row in rows if row.verdict != "told"}
    if not rows:
        yield f"{way}: no datagrams to measure; fly a mission first"
    elif judged and "mean" not in judged:
        yield f"{way}: one-way delays {NOT_JUDGED}: the ends do not share a clock"
    for row in rows:
        if row.verdict == "told":
            yield f"{way}: {row.name} {NOT_JUDGED}; docs/link.md says why"


def make_report(title: str, findings: Mapping[str, Findings]) -> Report:
    """Make the report as values for JSON, in SI units; leave out unknown values.

    Losses and other shares are in [0, 1]. `title` names the link. `findings` has an entry per
    direction.
    """
    shapers = {one.evidence.shaper or "an unknown shaper" for one in findings.values()}
    verdicts = {verdict_of(one.rows) for one in findings.values()}
    return {
        "verdict": next(one[0] for verdict, one in VERDICTS.items() if verdict in verdicts),
        "link": title,
        "shaper": f"shaped by {' and '.join(sorted(shapers))}",
        "causes": [cause._asdict() for cause in find_causes(findings)],
        "notes": [note for way, one in findings.items() for note in _notes(way, one.rows)],
        "directions": {
            way: {
                "probes": found.probes,
                "rows": [_as_json(row) for row in found.rows if row.verdict != "told"],
                "evidence": _known(found.evidence._asdict()),
            }
            for way, found in findings.items()
        },
    }


def _as_json(row: Judgement) -> dict[str, Any]:
    return {"name": row.name, "unit": row.unit} | _known(row._asdict())


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    unknown = (None, "", (), inf, -inf)
    return {key: one for key, one in values.items() if one not in unknown and one == one}


def as_text(report: Report) -> str:
    """Format a report: a table per direction, notes, causes and, in the last line, the verdict."""
    lines = [escape(f"{report['link']}: {report['shaper']}")]
    for way, found in report["directions"].items():
        rows = [[way, "asked", "measured", "allowed", "verdict"], *map(_cells, found["rows"])]
        lines += ["", escape(f"{way}: {found['probes']}"), table(rows, [1, 2, 3])]
    causes = [f"  {one['way']}: {one['text']}  [{one['code']}]" for one in report["causes"]]
    lines += ["", *map(escape, [*report["notes"], *causes])]
    partly = any(NOT_JUDGED in note for note in report["notes"]) and report["verdict"] == "believed"
    word, colour, text = next(one for one in VERDICTS.values() if one[0] == report["verdict"])
    text += f", except what is {NOT_JUDGED} (above)" * partly
    return "\n".join([*lines, paint(f"{word.upper()}: the link {text}", colour)])


def _cells(row: Mapping[str, Any]) -> list[str]:
    values = (row.get(key, nan) for key in KEYS)
    asked, measured, low, high = (in_unit(value, row["unit"]) for value in values)
    return [f"  {row['name']}", asked, measured, f"{low} .. {high}", row["verdict"]]
