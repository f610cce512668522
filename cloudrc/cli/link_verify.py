"""Run `cloudrc link verify`: compare a link with its profile, by probes or in flight.

On this machine the link runs as one process per direction; netem runs in two network namespaces,
joined by a veth pair, as between two pods. In a release each end judges the tunnel's own datagrams
and serves the result at /link.json of its metrics port; each link container shows what it shapes.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from math import inf, isfinite, nan
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np

from cloudrc.assembly import link_profile
from cloudrc.cli.cluster_flags import release_from_flags
from cloudrc.cli.link import VERIFY_DEFAULT
from cloudrc.cli.link_run import Programs, inspect_network
from cloudrc.cli.output import escape, format_document, paint, table
from cloudrc.cli.pool import interrupt_on_signals
from cloudrc.cluster.client import end_process
from cloudrc.cluster.pods import METRICS, NO_PROXY
from cloudrc.config import shipped
from cloudrc.config.document import write_yaml
from cloudrc.config.load import ResolvedExperiment, dump, read_experiment
from cloudrc.config.schema import Experiment, Profile
from cloudrc.drivers.machine import interpreter
from cloudrc.drivers.process import PARENT
from cloudrc.drivers.realtime import bind, free_ports, split_address
from cloudrc.errors import (
    BadInputError,
    CloudrcError,
    InvalidRunError,
    MissingPrerequisiteError,
    TimedOutError,
)
from cloudrc.link.netem import check
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.sidecar import Told, read_told
from cloudrc.link.state import STATE_FILE, from_text
from cloudrc.link.verify.causes import Findings, find_causes, read_evidence, read_metrics
from cloudrc.link.verify.judge import (
    RUN_LENGTH,
    UNITS,
    Flow,
    Plan,
    Row,
    judge,
    look_twice,
    tolerance,
    verdict_of,
)
from cloudrc.link.verify.monitor import PERIOD
from cloudrc.link.verify.probe import PROBE, ProbeEnd, plan_probes, send_probes
from cloudrc.tunnel.codec import SIZES, Kind

RELEASE_TIMEOUT = 270.0
"""Default time limit for the verdict on a release [s]."""
START_LIMIT = 90.0
"""Longest time for both processes to start, which a slow disk needs [s]."""
COUNTS_WAIT = 1.3
"""Time until the processes have counted the last probe [s]; they do so once a second."""
POLL_PERIOD, OFF_TIMEOUT, HTTP_TIMEOUT = 2.0, 30.0, 3.0
"""Pause between two polls, longest wait for a verdict once the other is "off", for a page [s]."""
PORTS = END_PORT, LINK_PORT = METRICS["world"]["world"], METRICS["world"]["link"]
LOOPBACK, DEVICE, PORT = "127.0.0.1", "tunnel", 7400
HOSTS = {"uplink": "10.79.7.1", "downlink": "10.79.7.2"}
"""Direction -> address of its sending end, in that end's namespace."""
WAYS = {
    "uplink": ("world", "cloud", Kind.TELEMETRY),
    "downlink": ("cloud", "world", Kind.COMMAND),
}
"""Direction -> the end that sends in it, the end that receives, and what."""
NAMES = {"mean": "delay, mean", "deviation": "standard deviation", "loss": "lost"}
SCALES = {"s": (1e3, "ms"), "1": (1e2, "%"), "bit/s": (1e-3, "kbit/s")}
NOT_JUDGED = "NOT JUDGED"
"""Mark in a note: something that the profile asks for was not verified."""
_MORE = "was not measured for long enough: give more --seconds, or ask again"
VERDICTS = {
    "off": ("not believed", "red", "does not match its profile"),
    "open": ("undecided", "yellow", _MORE),
    "ok": ("believed", "green", "matches its profile"),
}
"""Verdict of the rows, the worst first -> verdict on the link, its colour and a text."""
_CLONE_NEWNET = 0x40000000  # linux include/uapi/linux/sched.h

Report: TypeAlias = dict[str, Any]
Tell: TypeAlias = Callable[[str], None]
Pods: TypeAlias = Mapping[str, Sequence[str]]
"""End -> URLs of its own pages and of those of its link container."""


def execute(options: argparse.Namespace) -> int:
    """Measure the link, print the verdict; return 0 if the link is believed."""
    if options.seconds is not None and not 1.0 <= options.seconds <= 3600.0:
        raise BadInputError(f"--seconds {options.seconds:g}: give a number from 1 to 3600")
    interrupt_on_signals()  # on a signal, remove namespaces and processes
    if options.ends or options.mode == "cluster":
        limit = options.seconds or RELEASE_TIMEOUT
        with _pods(options) as pods:
            report = verify_release(options.release or "cloudrc", pods, limit, _tell)
    else:
        experiment = find_experiment(options.target, options.settings)
        report = verify(options.target, experiment, options.shaper, options.seconds, _tell)
    is_table = options.output == "table"
    print(as_text(report) if is_table else format_document(report, options.output))
    return 0 if report["verdict"] == "believed" else 1


def _tell(line: str) -> None:
    """Show progress in one line, on a terminal only."""
    if sys.stderr.isatty():
        print(f"\r\x1b[K{escape(line)}", end="", file=sys.stderr, flush=True)


def find_experiment(target: str, settings: list[str]) -> ResolvedExperiment:
    """Find the experiment; a profile replaces the link of the default experiment."""
    experiments, profiles = shipped.names("experiment"), shipped.names("profile")
    if shipped.is_path(target):
        keys = set(shipped.read("profile", target, Path.cwd()).tree)
        is_profile = keys.isdisjoint(Experiment.model_fields.keys() - Profile.model_fields.keys())
        target = str(Path.cwd() / target)
    elif target in (*experiments, *profiles):
        is_profile = target not in experiments
    else:
        names = ", ".join([*profiles, *experiments])
        raise BadInputError(f"no profile or experiment named '{target}'; available: {names}")
    if not is_profile:
        return read_experiment(target, settings)
    return read_experiment(VERIFY_DEFAULT, [f"link.profile={target}", *settings])


@dataclass(slots=True)
class Way:
    """One direction of a link under test: its probes' socket, the shaper's files and process."""

    own: socket.socket
    peer: tuple[str, int]
    ports: Sequence[int]  # where a relay receives, and where the process serves its pages
    namespace: str = ""  # of the network; "" for this process's
    folder: Path = Path()
    process: subprocess.Popen[bytes] | None = None

    def get(self, page: str) -> str:
        """Fetch a page of the process; "" without an answer."""
        with inside(self.namespace):
            return fetch(f"http://{LOOPBACK}:{self.ports[1]}/{page}")


def verify(
    title: str,
    experiment: ResolvedExperiment,
    shaper: str,
    seconds: float | None,
    tell: Tell,
    applied: Profile | None = None,
    meddle: Callable[[Mapping[str, Way]], None] = lambda ways: None,
) -> Report:
    """Probe a link for `seconds` [s], None for as long as needed; look twice at what is off.

    Tests inject faults: by another profile `applied`, and by a function that gets the running link.
    """
    tell("planning the probes")
    plans, found = make_plans(experiment, seconds, shaper), dict[str, Findings]()
    for look in ("sending probes", "looking again at what is off"):
        tell(f"{look}: {max(plan.sent[-1] for plan in plans.values()):.0f} s")
        with run_link(experiment, shaper, applied) as ways:
            meddle(ways)
            now = probe_link(ways, plans)
        rows = {way: look_twice(found.get(way, now[way]).rows, now[way].rows) for way in now}
        found = {way: now[way]._replace(rows=rows[way]) for way in now}
        if "off" not in {verdict_of(one.rows) for one in found.values()}:
            break
    tell("")
    notes = [
        _on_correlation(way, plan.profile.correlation)
        for way, plan in plans.items()
        if shaper == "netem" and plan.profile.correlation and plan.profile.jitter
    ] + [
        f"{way}: rate {NOT_JUDGED}: this machine itself is hardly faster"
        for way, plan in plans.items()
        if plan.profile.rate and not plan.train
    ]
    counts = {way: f"{len(p.sent)} probes of {p.flow.size} bytes" for way, p in plans.items()}
    return make_report(title, found, counts, notes)


def make_plans(
    experiment: ResolvedExperiment, seconds: float | None, shaper: str
) -> dict[str, Plan]:
    """Plan probes of the size of datagrams for `seconds` [s]; None: as long as needed.

    Raises:
        BadInputError: If netem cannot realise the profile; names the direction.
    """
    plans, netem = {}, shaper == "netem"
    for way, (_, _, kind) in WAYS.items():
        flow = Flow(experiment.seed, way == "uplink", PROBE, SIZES[kind])
        profile = link_profile(getattr(experiment, way))
        try:
            if netem:
                check(profile)
        except BadInputError as error:
            raise BadInputError(_advise(f"{way}: {error}")) from None
        plans[way] = plan_probes(profile, flow, seconds, drawn=netem)
    return plans


def probe_link(ways: Mapping[str, Way], plans: Mapping[str, Plan]) -> dict[str, Findings]:
    """Send all probes over a running link and judge them."""
    since_wall_ns, found = time.time_ns() - time.monotonic_ns(), {}
    states = {name: from_text((way.folder / STATE_FILE).read_text()) for name, way in ways.items()}
    ends = [
        ProbeEnd(
            *(way.own, split_address((way.folder / "route").read_text()), plans[name]),
            (states[name].origin_ns or 0) + since_wall_ns,
        )
        for name, way in ways.items()
    ]
    streams = send_probes(ends)
    time.sleep(COUNTS_WAIT)
    for (name, way), stream in zip(ways.items(), streams, strict=True):
        plan, page, metrics = plans[name], way.get("link.json"), read_metrics(way.get("metrics"))
        with inside(way.namespace):  # a process that hangs says nothing, the kernel does
            near = inspect_network(way.peer[0])
        told = read_told(page) if page else Told(states[name].shaper, states[name].reason, None)
        known = read_evidence(replace(told, near=near), metrics, len(stream.sent))
        rows = judge(plan, stream, plan.expected(stream), plan.applied(known.applied))
        found[name] = Findings(rows, known)
    return found


@contextlib.contextmanager
def run_link(
    experiment: ResolvedExperiment, shaper: str, applied: Profile | None = None
) -> Iterator[dict[str, Way]]:
    """Run both directions of a link: on loopback, or for netem in two namespaces.

    Raises:
        CloudrcError: If a process ends early, with its message and exit code, or starts too slowly.
    """
    profile = applied or Profile(uplink=experiment.uplink, downlink=experiment.downlink)
    text = write_yaml(profile.model_dump(mode="json", exclude_defaults=True))
    with contextlib.ExitStack() as stack:
        ways = stack.enter_context(_open_namespaces() if shaper == "netem" else _open_loopback())
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="cloudrc-verify-")))
        (folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        (folder / "profile.yaml").write_text(text, encoding="utf-8")
        for name, way in ways.items():
            way.folder = folder / name
            way.folder.mkdir()
            way.process = _start(name, way, shaper)
            stack.callback(end_process, way.process)
        deadline = time.monotonic() + START_LIMIT
        while not all((way.folder / "route").exists() for way in ways.values()):
            for name, way in ways.items():
                if way.process and (code := way.process.poll()) is not None:
                    raise _ended(name, code, (way.folder / "log").read_text(errors="replace"))
            if time.monotonic() > deadline:
                raise TimedOutError(f"the link was not up within {START_LIMIT:g} s; try again")
            time.sleep(0.02)
        yield ways


def _start(name: str, way: Way, shaper: str) -> subprocess.Popen[bytes]:
    relay, pages = (f"{LOOPBACK}:{port}" for port in way.ports)
    words = [f"--peer={way.peer[0]}:{way.peer[1]}", f"--listen={relay}", f"--metrics={pages}"]
    words += [f"--{file}={way.folder.parent / file}.yaml" for file in ("config", "profile")]
    words += [f"--direction={name}", f"--mode={shaper}", f"--route={way.folder / 'route'}"]
    with (way.folder / "log").open("wb") as log, inside(way.namespace):
        return subprocess.Popen(
            interpreter("-m", "cloudrc", "link", "run", *words),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={**os.environ, PARENT: str(os.getpid())},
            start_new_session=True,  # Ctrl-C reaches this process alone, which stops them
        )


def _advise(text: str) -> str:
    """Replace the advice for a chart by the one for this command."""
    return text.replace("set link.mode=", "use --shaper ")


def _ended(name: str, code: int, log: str) -> CloudrcError:
    """Pass on the error of a process: the last line of its log, and its exit code."""
    last = (log.strip().splitlines() or ["it left no message"])[-1]
    words = _advise(last.removeprefix("cloudrc: error: "))
    known = {one.exit_code: one for one in (BadInputError, MissingPrerequisiteError, TimedOutError)}
    if code in known:
        return known[code](f"the {name} is not shaped: {words}")
    return InvalidRunError(f"the {name} is not shaped: its process ended with {code}: {words}")


@contextlib.contextmanager
def _open_loopback() -> Iterator[dict[str, Way]]:
    with bind((LOOPBACK, 0)) as up, bind((LOOPBACK, 0)) as down:
        ports = free_ports(4)
        yield {
            "uplink": Way(up, down.getsockname(), (ports[0], ports[1])),
            "downlink": Way(down, up.getsockname(), (ports[2], ports[3])),
        }


@contextlib.contextmanager
def _open_namespaces() -> Iterator[dict[str, Way]]:
    if os.geteuid() != 0:
        raise MissingPrerequisiteError(
            "netem is verified between two network namespaces, which needs root; run this as root,"
            " or verify the relay (--shaper relay)"
        )
    names, ways = {way: f"cloudrc-{way}-{os.getpid()}" for way in HOSTS}, {}
    near, far = names.values()
    with contextlib.ExitStack() as stack:
        for name in names.values():
            _ip("netns", "add", name)
            stack.callback(_ip, "netns", "del", name)
        _ip("-n", near, "link", "add", DEVICE, "type", "veth", "peer", DEVICE, "netns", far)
        for (way, name), peer in zip(names.items(), reversed(HOSTS.values()), strict=True):
            _ip("-n", name, "addr", "add", f"{HOSTS[way]}/24", "dev", DEVICE)
            for device in ("lo", DEVICE):
                _ip("-n", name, "link", "set", device, "up")
            with inside(name):
                own = stack.enter_context(bind((HOSTS[way], PORT)))
            ways[way] = Way(own, (peer, PORT), (PORT + 1, PORT + 2), name)
        yield ways


def _ip(*words: str) -> None:
    if (answer := Programs()(("ip", *words))).code:
        failure = " ".join(answer.error.split()) or "no program ip (package iproute2)"
        raise MissingPrerequisiteError(f"ip {' '.join(words)}: {failure}; use --shaper relay")


@contextlib.contextmanager
def inside(namespace: str) -> Iterator[None]:
    """Move this thread into a network namespace, if one is named.

    Sockets that are opened inside and processes that are started inside stay there.
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
    """Find the pages of a release's ends, at given hosts or through the cluster's API."""
    hosts = options.ends.split(",") if options.ends else []
    if hosts and (len(hosts) != 2 or not all(hosts)):
        raise BadInputError(f"--ends {options.ends}: give two hosts, WORLD,CLOUD")
    with contextlib.ExitStack() as stack:
        bases = [[f"{host}:{port}" for port in PORTS] for host in hosts]
        if not hosts:
            from cloudrc.cluster.pods import find_pod, forwarded

            release = release_from_flags(options)
            for end in ("world", "cloud"):
                pod = find_pod(release, end).metadata.name
                local = stack.enter_context(forwarded(release, pod, PORTS))
                bases.append([f"{LOOPBACK}:{local[port]}" for port in PORTS])
        urls = [[f"http://{base}" for base in pair] for pair in bases]
        yield dict(zip(("world", "cloud"), urls, strict=True))


def verify_release(title: str, pods: Pods, limit: float, tell: Tell) -> Report:
    """Wait at most `limit` [s] for the verdicts of both ends.

    Raises:
        TimedOutError: If an end does not answer in time.
    """
    deadline, off_deadline = time.monotonic() + limit, inf
    seen = dict[str, Any]()
    while True:
        tell(", ".join(note for way, found in seen.items() for note in _patience(way, found)))
        time.sleep(POLL_PERIOD)
        for way, (_, receiver, _) in WAYS.items():
            if page := fetch(f"{pods[receiver][0]}/link.json"):
                seen[way] = json.loads(page)
        verdicts, now = [found["verdict"] for found in seen.values()], time.monotonic()
        off_deadline = min(off_deadline, now + OFF_TIMEOUT) if "off" in verdicts else inf
        waits = [way for way in WAYS if way not in seen or _may_change(seen[way])]
        if not waits or now >= min(deadline, off_deadline):
            break
    tell("")
    if silent := [receiver for way, (_, receiver, _) in WAYS.items() if way not in seen]:
        text = f"{' and '.join(silent)} did not answer within {limit:g} s: are the pods ready?"
        raise TimedOutError(text)
    findings = {way: _findings(way, seen[way], pods[WAYS[way][0]][1]) for way in WAYS}
    counts = {way: max([row["datagrams"] for row in seen[way]["rows"]], default=0) for way in WAYS}
    probes = {way: f"{counts[way]} of the tunnel's own datagrams" for way in WAYS}
    notes = [note for way in WAYS for note in _notes(way, seen[way], findings[way])]
    return make_report(title, findings, probes, notes)


def fetch(url: str) -> str:
    """Fetch a page without a proxy; "" without an answer."""
    try:
        with NO_PROXY.open(url, timeout=HTTP_TIMEOUT) as page:
            return str(page.read().decode())
    except OSError:
        return ""


def _may_change(found: Mapping[str, Any]) -> bool:
    """Return whether a verdict may still come; a time line that loops never gets one."""
    loops = any(row["quantity"] == "time_line" and row.get("measured") for row in found["rows"])
    return bool(found["verdict"] == "open") and not loops


def _findings(way: str, found: Mapping[str, Any], link: str) -> Findings:
    """Combine the receiver's verdict with what the sender's link reports at a URL."""
    kind, told = WAYS[way][2], Told("", "", None)
    with contextlib.suppress(ValueError):
        told = read_told(fetch(f"{link}/link.json"))
    known = read_evidence(told, read_metrics(fetch(f"{link}/metrics")))
    flow = Flow(0, way == "uplink", kind, SIZES[kind])
    plan = Plan(DirectionProfile(), flow, np.arange(float(RUN_LENGTH)) * PERIOD)
    applied, rows = plan.applied(known.applied), []
    for row in found["rows"]:
        name, verdict = row["quantity"], row["verdict"]
        values = (row.get(key, nan) for key in ("asked", "measured", "low", "high"))
        asked, measured, low, high = map(float, values)
        in_force = applied.get(name, nan)
        if name == "rate" and known.applied:  # single datagrams do not measure it
            in_force, slack = known.applied.rate or inf, tolerance("rate", asked)
            if abs(in_force - asked) > slack:
                verdict, low, high = "off", asked - slack, asked + slack
        if verdict != "told":
            unit = UNITS.get(name, "1")
            rows.append(Row(name, unit, asked, in_force, measured, low, high, verdict))
    return Findings(rows, known)


def _notes(way: str, found: Mapping[str, Any], finding: Findings) -> Iterator[str]:
    """Note what was not judged, and how much longer it takes."""
    rows = {row["quantity"]: row for row in found["rows"]}
    judged = {row.name for row in finding.rows}
    if not judged and "time_line" not in rows:
        hint = "fly a mission first" if way == "downlink" else "is the other end ready?"
        yield f"{way}: no datagrams to measure; {hint}"
    elif "round_trip" in judged:
        yield f"{way}: the ends do not share a clock: judged by round trips, not one-way delays"
    elif judged and "mean" not in judged:
        yield f"{way}: delays {NOT_JUDGED}: the ends do not share a clock"
    if "rate" in rows and "rate" not in judged:
        yield f"{way}: rate {NOT_JUDGED}: single datagrams do not measure it"
    if "correlation" in rows:
        yield _on_correlation(way, rows["correlation"]["asked"])
    if rows.get("time_line", {}).get("measured"):
        yield f"{way}: {NOT_JUDGED} in flight: a time line loops; probe it without --mode cluster"
    elif "time_line" in rows:
        yield f"{way}: its time line {NOT_JUDGED} in flight, only what follows it"
    yield from _patience(way, found)


def _patience(way: str, found: Mapping[str, Any]) -> Iterator[str]:
    for row in found["rows"]:
        if _may_change(found) and row["quantity"] == "datagrams":
            needs, count = round(row["asked"]), round(row["measured"])
            seconds = max(0, needs - count) * PERIOD
            yield f"{way}: {count} of {needs} datagrams, {seconds:.0f} s more"


def _on_correlation(way: str, asked: float) -> str:
    return f"{way}: correlation {asked:g} {NOT_JUDGED}: netem realises almost none of it"


def make_report(
    title: str, findings: Mapping[str, Findings], probes: Mapping[str, str], notes: Sequence[str]
) -> Report:
    """Make plain values in SI units, shares in [0, 1]; unknown values are left out."""
    shapers = {one.evidence.shaper or "an unknown shaper" for one in findings.values()}
    verdicts = {verdict_of(one.rows) for one in findings.values()}
    return {
        "schemaVersion": 1,
        "verdict": next(one[0] for verdict, one in VERDICTS.items() if verdict in verdicts),
        "link": title,
        "shaper": f"shaped by {' and '.join(sorted(shapers))}",
        "causes": [cause._asdict() for cause in find_causes(findings)],
        "notes": list(notes),
        "directions": {
            way: {
                "probes": probes[way],
                "rows": [_known(row._asdict()) for row in found.rows],
                "evidence": _known(asdict(found.evidence) | {"applied": None}),
            }
            for way, found in findings.items()
        },
    }


def _known(values: Mapping[str, Any]) -> dict[str, Any]:
    unknown = (None, "", (), inf, -inf)
    return {key: one for key, one in values.items() if one not in unknown and one == one}


def as_text(report: Report) -> str:
    """Format a table per direction, notes, causes, and the verdict in the last line."""
    lines = [escape(f"{report['link']}: {report['shaper']}")]
    for way, found in report["directions"].items():
        heads = [way, "asked", "applied", "measured", "allowed", "verdict"]
        head, _, body = table([heads, *map(_cells, found["rows"])], [1, 2, 3, 4]).partition("\n")
        lines += ["", head, escape(f"  {found['probes']}"), body]
    causes = [f"  {one['way']}: {one['text']}  [{one['code']}]" for one in report["causes"]]
    lines += ["", *map(escape, [*report["notes"], *causes])]
    partly = any(NOT_JUDGED in note for note in report["notes"]) and report["verdict"] == "believed"
    word, colour, text = next(one for one in VERDICTS.values() if one[0] == report["verdict"])
    text += f", except what is {NOT_JUDGED} (above)" * partly
    return "\n".join([*lines, paint(f"{word.upper()}: the link {text}", colour)])


def _cells(row: Mapping[str, Any]) -> list[str]:
    scale, unit = SCALES[row["unit"]]
    names = ("asked", "applied", "measured", "low", "high")
    asked, applied, measured, low, high = (_number(row.get(name, nan) * scale) for name in names)
    allowed = f"{low} .. {high}" if row.get("low") else f"<= {high}"
    name = NAMES.get(row["name"], row["name"].replace("_", " "))
    return [f"  {name} [{unit}]", asked, applied, measured, allowed, row["verdict"]]


def _number(value: float) -> str:
    return "-" if not isfinite(value) else f"{value:.2f}" if value < 1e4 else f"{value:.0f}"
