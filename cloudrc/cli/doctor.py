"""`cloudrc doctor`: check whether flights work on this machine; explain how to fix problems."""

from __future__ import annotations

import argparse
import ctypes.util
import importlib.metadata
import os
import platform
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from cloudrc.cli.extras import EXTRAS, missing
from cloudrc.cli.output import format_document, output_argument, paint, table
from cloudrc.drivers.machine import interpreter
from cloudrc.errors import CloudrcError, MissingPrerequisiteError

if TYPE_CHECKING:
    from cloudrc.cluster.client import Release


FLYING = ("virtual", "local")
CLUSTER = ("cluster",)


@dataclass(frozen=True, slots=True)
class Check:
    """The result of one check.

    Attributes:
        name: The subject of the check.
        state: "ok"; "missing": some modes cannot run; "warn": flights work, but see `fix`.
        found: What the check has found, as text for people.
        fix: What the user should do; empty if nothing.
        modes: Modes that cannot run if the check says "missing".
    """

    name: str
    state: Literal["ok", "warn", "missing"]
    found: str
    fix: str = ""
    modes: tuple[str, ...] = ()


NEEDED = {
    "helm": "https://helm.sh/docs/intro/install",
    "kubectl": "https://kubernetes.io/docs/tasks/tools",
}
"""Programs that mode cluster calls -> their installation pages."""
HELPFUL = {
    "docker": "https://docs.docker.com/engine/install",
    "kind": "https://kind.sigs.k8s.io",
}
"""Programs that make a cluster on this machine -> their installation pages; a remote cluster needs
none of these programs."""
MAKE_CLUSTER = "kind create cluster --config kind-config.yaml"
DOCKER_LIMIT = 5.0
"""Time limit for Docker's daemon to answer [s]."""


def programs() -> Iterator[Check]:
    """Check the programs that mode cluster uses."""
    for name, where in NEEDED.items():
        path = shutil.which(name)
        if path is None:
            yield Check(name, "missing", "not in PATH", where, CLUSTER)
        else:
            yield Check(name, "ok", path, "", CLUSTER)
    for name, where in HELPFUL.items():
        path = shutil.which(name)
        if path is None:
            yield Check(name, "warn", "not in PATH", f"to make a cluster here: {where}")
        elif name == "docker" and not _docker_answers(path):
            fix = "to make a cluster here, start it; 'docker info' shows what is wrong"
            yield Check(name, "warn", f"{path}, but its daemon does not answer", fix)
        else:
            yield Check(name, "ok", path)


def cluster(context: str | None) -> Iterator[Check]:
    """Check the kubeconfig, and check whether its cluster answers.

    Args:
        context: A context of the kubeconfig; None for the current one.
    """
    if missing("kube"):
        return  # another check reports that
    from cloudrc.cluster.client import connect

    try:
        release = connect(context)
    except CloudrcError as error:
        found, _, fix = str(error).partition("; ")
        yield Check("kubeconfig", "missing", _short(found), fix, CLUSTER)
        return
    where = f"context {context}" if context else "its current context"
    yield Check("kubeconfig", "ok", f"{where}, namespace {release.namespace}", "", CLUSTER)
    yield _answering(release)


def _answering(release: Release) -> Check:
    from cloudrc.cluster.client import OLDEST, server_version

    oldest = ".".join(map(str, OLDEST))
    try:
        version = server_version(release)
    except CloudrcError as error:
        found, _, fix = str(error).partition("; ")
        return Check("cluster", "missing", _short(found), fix or MAKE_CLUSTER, CLUSTER)
    found = f"Kubernetes {version[0]}.{version[1]}"
    if version < OLDEST:
        fix = f"the chart needs {oldest}: upgrade it, or {MAKE_CLUSTER}"
        return Check("cluster", "missing", f"{found}, too old", fix, CLUSTER)
    return Check("cluster", "ok", f"{found} answers", "", CLUSTER)


def _docker_answers(path: str) -> bool:
    command = [path, "version", "--format={{.Server.Version}}"]
    try:
        return subprocess.run(command, capture_output=True, timeout=DOCKER_LIMIT).returncode == 0
    except (OSError, subprocess.TimeoutExpired):
        return False


def _short(text: str) -> str:
    return text if len(text) <= 120 else f"{text[:117]}..."


LATE_SLEEP = 2e-3
"""Largest lateness that a control loop with a period of 10 ms tolerates [s]; an idle desktop stays
far below."""

MUJOCO_PROGRAM = (
    "import mujoco; m = mujoco.MjModel.from_xml_string('<mujoco/>'); "
    "mujoco.mj_step(m, mujoco.MjData(m)); print(mujoco.__version__)"
)


def all_checks(mode: str = "local", context: str | None = None) -> Iterator[Check]:
    """Run every check, in the order of display.

    Args:
        mode: The wanted mode; only "cluster" contacts a cluster.
        context: A context of the kubeconfig; None for the current one.
    """
    yield python()
    for extra in EXTRAS:
        yield packages(extra)
    yield mujoco_steps()
    yield udp_loopback()
    yield timer()
    yield cores()
    yield graphics()
    yield from programs()
    if mode in CLUSTER:
        yield from cluster(context)
    yield netem()
    yield cgroup()


def python() -> Check:
    """Check the interpreter's version."""
    enough = sys.version_info >= (3, 11)
    state: Literal["ok", "missing"] = "ok" if enough else "missing"
    fix = "" if enough else "install Python 3.11 or newer"
    return Check("python", state, platform.python_version(), fix, (*FLYING, *CLUSTER))


def packages(extra: str) -> Check:
    """Check the packages of one extra."""
    everywhere = (*FLYING, *CLUSTER)
    users = {"world": FLYING, "record": everywhere, "report": everywhere, "kube": CLUSTER}
    modes = users.get(extra, ())
    absent = missing(extra)
    if absent:
        fix = f"pip install 'cloudrc[{extra}]'"
        return Check(f"extra {extra}", "missing", f"no {', '.join(absent)}", fix, modes)
    versions = [f"{name} {importlib.metadata.version(name)}" for name in EXTRAS[extra]]
    return Check(f"extra {extra}", "ok", ", ".join(versions), "", modes)


def mujoco_steps() -> Check:
    """Run a step of MuJoCo in a separate process, because a broken library can abort a process."""
    answer = subprocess.run(interpreter("-c", MUJOCO_PROGRAM), capture_output=True, text=True)
    if answer.returncode == 0:
        return Check("physics", "ok", "MuJoCo loads and steps", "", FLYING)
    lines = answer.stderr.strip().splitlines() or [f"exit code {answer.returncode}"]
    gl = os.environ.get("MUJOCO_GL")
    fix = f"unset MUJOCO_GL (it is '{gl}')" if gl else "pip install --force-reinstall mujoco"
    return Check("physics", "missing", lines[-1][:120], fix, FLYING)


def udp_loopback(rounds: int = 200) -> Check:
    """Send datagrams over 127.0.0.1 and measure the round trip."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as loopback:
            loopback.bind(("127.0.0.1", 0))
            loopback.settimeout(1.0)
            trips = []
            for _ in range(rounds):
                start = time.perf_counter()
                loopback.sendto(b"cloudrc", loopback.getsockname())
                loopback.recv(16)
                trips.append(time.perf_counter() - start)
    except OSError as error:
        fix = "allow UDP on 127.0.0.1 (a sandbox or a firewall blocks it)"
        return Check("udp loopback", "missing", str(error), fix, ("local",))
    median = sorted(trips)[rounds // 2] * 1e6
    return Check("udp loopback", "ok", f"works, median {median:.0f} us", "", ("local",))


def timer(rounds: int = 100) -> Check:
    """Measure how late a sleep of 1 ms ends."""
    late = []
    for _ in range(rounds):
        start = time.monotonic()
        time.sleep(1e-3)
        late.append(time.monotonic() - start - 1e-3)
    worst = sorted(late)[int(0.99 * rounds) - 1]
    found = f"sleeps end {worst * 1e3:.2f} ms late (99 %)"
    if worst > LATE_SLEEP:
        return Check("timer", "warn", found, "close busy programs, or use --mode virtual")
    return Check("timer", "ok", found)


def cores() -> Check:
    """Compare the machine's load with the number of cores that this process may use."""
    count = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    load = os.getloadavg()[0]
    found = f"{count}, load {load:.1f}"
    if count < 2:
        return Check("cores", "warn", found, "real time needs two; --mode virtual flies on one")
    if load > count:
        return Check("cores", "warn", found, "other programs use them: close some or wait")
    return Check("cores", "ok", found)


def graphics() -> Check:
    """Check for OpenGL, which is optional."""
    found = [name for name in ("EGL", "OSMesa", "GL") if ctypes.util.find_library(name)]
    return Check("graphics", "ok", ", ".join(found) if found else "no GL; not needed")


def netem() -> Check:
    """Check for the kernel's network emulator; the relay can replace it."""
    release = platform.release()
    modules = Path("/lib/modules") / release
    builtin = "sch_netem" in _text_of(modules / "modules.builtin")
    if builtin or Path("/sys/module/sch_netem").exists():
        return Check("sch_netem", "ok", f"in kernel {release}")
    if "sch_netem" in _text_of(modules / "modules.dep"):
        return Check("sch_netem", "ok", "a module, not loaded yet")
    return Check(
        "sch_netem", "warn", "not found", "none needed: the relay emulates the link instead"
    )


def cgroup() -> Check:
    """Check for control groups, which report how long a CPU limit has paused a process."""
    if Path("/sys/fs/cgroup/cgroup.controllers").exists():
        return Check("cgroup", "ok", "v2")
    if Path("/sys/fs/cgroup").is_dir():
        return Check("cgroup", "ok", "v1")
    return Check("cgroup", "warn", "none", "none needed, but the metrics of CPU limits stay empty")


def _text_of(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""


COLOURS = {"ok": "green", "warn": "yellow", "missing": "red"}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--mode",
        choices=("virtual", "local", "cluster"),
        default="local",
        help="the mode to fly in (default: local)",
    )
    parser.add_argument("--context", metavar="NAME", help="kubeconfig context (default: current)")
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Print all checks; exit 3 if the wanted mode cannot run."""
    checks = list(all_checks(options.mode, options.context))
    blocking = [c.name for c in checks if c.state == "missing" and options.mode in c.modes]
    if options.output != "table":
        print(format_document(_document(options.mode, checks, blocking), options.output))
    else:
        print(_as_text(options.mode, checks, blocking))
    return MissingPrerequisiteError.exit_code if blocking else 0


def _document(mode: str, checks: list[Check], blocking: list[str]) -> dict[str, object]:
    return {
        "schemaVersion": 1,
        "mode": mode,
        "ready": not blocking,
        "checks": [asdict(check) for check in checks],
    }


def _as_text(mode: str, checks: list[Check], blocking: list[str]) -> str:
    needed = [c for c in checks if mode in c.modes]
    useful = [c for c in checks if mode not in c.modes]
    blocks = {f"Needed for mode {mode}:": needed, "Good to know:": useful}
    parts = [f"{title}\n{_block(block)}\n" for title, block in blocks.items() if block]
    if blocking:
        parts.append(paint(f"Mode {mode} cannot run: {', '.join(blocking)}.", "red"))
    else:
        parts.append(paint(f"Mode {mode} can run.", "green"))
    return "\n".join(parts)


def _block(checks: list[Check]) -> str:
    rows = [(check.state, check.name, check.found) for check in checks]
    lines = []
    for check, line in zip(checks, table(rows).splitlines(), strict=True):
        lines.append("  " + line.replace(check.state, paint(check.state, COLOURS[check.state]), 1))
        if check.fix:
            lines.append(f"           -> {check.fix}")
    return "\n".join(lines)
