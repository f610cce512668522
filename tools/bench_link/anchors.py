"""The two small programs in C that the relay is held against: compiled here, or exit 3."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np

from cloudrc.errors import MissingPrerequisiteError
from tools.bench_link.judge import Array

SOURCES = Path(__file__).parent / "c"


def compile_anchors(folder: Path) -> tuple[Path, Path]:
    """Compile both into a folder.

    Returns:
        The programs `wake_lateness` and `relay`.

    Raises:
        MissingPrerequisiteError: If there is no C compiler, or it fails.
    """
    compiler = shutil.which("cc")
    if compiler is None:
        raise MissingPrerequisiteError(
            "bench-link compiles two anchors and finds no C compiler 'cc'; apt-get install gcc"
        )
    for name in ("wake_lateness", "relay"):
        command = [compiler, "-O2", "-o", str(folder / name), str(SOURCES / f"{name}.c")]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            line = (done.stderr.strip().splitlines() or ["no message"])[0]
            raise MissingPrerequisiteError(f"cc cannot compile {name}.c: {line}; see its packages")
    return folder / "wake_lateness", folder / "relay"


def wake_lateness(program: Path, count: int, *, fifo: bool) -> Array:
    """Let C sleep until instants 1 ms apart.

    Returns:
        How late it woke [s], shape (count,).
    """
    first = ["chrt", "-f", "10"] if fifo else []
    command = [*first, str(program), str(count)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return np.array(done.stdout.split(), dtype=float) * 1e-9


def fifo_allowed() -> bool:
    """Say whether this user may run programs under SCHED_FIFO."""
    if shutil.which("chrt") is None:
        return False
    done = subprocess.run(["chrt", "-f", "10", "true"], capture_output=True, check=False)
    return done.returncode == 0
