"""The checks of `cloudrc doctor`: what this machine has, and the mend for what it has not."""

from __future__ import annotations

import ctypes.util
import importlib.metadata
import os
import platform
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from cloudrc.cli import checks_cluster
from cloudrc.cli.check import CLUSTER, FLYING, Check
from cloudrc.cli.extras import EXTRAS, missing
from cloudrc.drivers.machine import interpreter

# What a control loop of 10 ms can bear; a quiet desktop stays far below [s].
LATE_SLEEP = 2e-3

STEP = (
    "import mujoco; m = mujoco.MjModel.from_xml_string('<mujoco/>'); "
    "mujoco.mj_step(m, mujoco.MjData(m)); print(mujoco.__version__)"
)


def all_checks(mode: str = "local", context: str | None = None) -> Iterator[Check]:
    """Run every check, in the order in which they are shown.

    Args:
        mode: That is wanted; a cluster is asked only if it is "cluster".
        context: Of the kubeconfig; None for the current one.
    """
    yield python()
    for extra in EXTRAS:
        yield packages(extra)
    yield mujoco_steps()
    yield udp_loopback()
    yield timer()
    yield cores()
    yield graphics()
    yield from checks_cluster.programs()
    if mode in CLUSTER:
        yield from checks_cluster.cluster(context)
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
    wanted = {"world": FLYING, "record": everywhere, "report": everywhere, "kube": CLUSTER}
    modes = wanted.get(extra, ())
    absent = missing(extra)
    if absent:
        fix = f"pip install 'cloudrc[{extra}]'"
        return Check(f"extra {extra}", "missing", f"no {', '.join(absent)}", fix, modes)
    versions = [f"{name} {importlib.metadata.version(name)}" for name in EXTRAS[extra]]
    return Check(f"extra {extra}", "ok", ", ".join(versions), "", modes)


def mujoco_steps() -> Check:
    """Load MuJoCo and make one step, in a process of its own: a bad library can abort."""
    answer = subprocess.run(interpreter("-c", STEP), capture_output=True, text=True)
    if answer.returncode == 0:
        return Check("physics", "ok", "MuJoCo loads and steps", "", FLYING)
    lines = answer.stderr.strip().splitlines() or [f"exit code {answer.returncode}"]
    gl = os.environ.get("MUJOCO_GL")
    fix = f"unset MUJOCO_GL (it is '{gl}')" if gl else "pip install --force-reinstall mujoco"
    return Check("physics", "missing", lines[-1][:120], fix, FLYING)


def udp_loopback(rounds: int = 200) -> Check:
    """Send datagrams over 127.0.0.1 and back, through three free ports."""
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
            here.bind(("127.0.0.1", 0))
            here.settimeout(1.0)
            trips = []
            for _ in range(rounds):
                start = time.perf_counter()
                here.sendto(b"cloudrc", here.getsockname())
                here.recv(16)
                trips.append(time.perf_counter() - start)
    except OSError as error:
        fix = "allow UDP on 127.0.0.1 (a sandbox or a firewall refuses it)"
        return Check("udp loopback", "missing", str(error), fix, ("local",))
    median = sorted(trips)[rounds // 2] * 1e6
    return Check("udp loopback", "ok", f"port free, median {median:.0f} us", "", ("local",))


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
    """Compare the cores that this process may use with what already runs."""
    count = (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    )
    load = os.getloadavg()[0]
    found = f"{count}, load {load:.1f}"
    if count < 2:
        return Check("cores", "warn", found, "real time wants two; --mode virtual flies on one")
    if load > count:
        return Check("cores", "warn", found, "others use them: close programs or wait")
    return Check("cores", "ok", found)


def graphics() -> Check:
    """Look for GL; flying and reporting need none."""
    found = [name for name in ("EGL", "OSMesa", "GL") if ctypes.util.find_library(name)]
    return Check("graphics", "ok", ", ".join(found) if found else "no GL, and none is needed")


def netem() -> Check:
    """Look for the kernel's network emulator; the userspace relay stands in for it."""
    release = platform.release()
    modules = Path("/lib/modules") / release
    builtin = "sch_netem" in _text(modules / "modules.builtin")
    if builtin or Path("/sys/module/sch_netem").exists():
        return Check("sch_netem", "ok", f"in kernel {release}")
    if "sch_netem" in _text(modules / "modules.dep"):
        return Check("sch_netem", "ok", "a module, not loaded yet")
    return Check("sch_netem", "warn", "not found", "the relay shapes the link without it")


def cgroup() -> Check:
    """Look for control groups: what a CPU limit holds back is read from v1 and v2 alike."""
    if Path("/sys/fs/cgroup/cgroup.controllers").exists():
        return Check("cgroup", "ok", "v2")
    if Path("/sys/fs/cgroup").is_dir():
        return Check("cgroup", "ok", "v1")
    return Check("cgroup", "warn", "none", "the metrics of CPU limits stay empty on this machine")


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
