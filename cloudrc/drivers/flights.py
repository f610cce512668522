"""Flights under way on this machine: each says where it is, so that its operator need not know.

A small file per flight, in a folder that is this user's alone. It is locked for as long as the
flight lasts: what a killed one has left behind is known by that, and taken away.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

FOLDER = Path("cloudrc", "flights")
PRIVATE = 0o700


def places() -> list[Path]:
    """Where such files may be; a login has both places, a job of cron perhaps only the second.

    Source: XDG Base Directory Specification.
    """
    roots = []
    if runtime := os.environ.get("XDG_RUNTIME_DIR"):
        roots.append(Path(runtime))
    with contextlib.suppress(RuntimeError):  # a user without a home
        roots.append(Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state"))
    return [root / FOLDER for root in dict.fromkeys(roots)]


@contextlib.contextmanager
def announced(run: Path) -> Iterator[None]:
    """Tell of the flight of a run's folder for as long as the block lasts.

    Where no such file can be written it flies all the same, and is found by its folder alone.
    """
    path, lock = None, -1
    for place in places():
        with contextlib.suppress(OSError):
            path, lock = _write(place, run)
            break
    try:
        yield
    finally:
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink()
            os.close(lock)


def under_way() -> list[Path]:
    """Folders of the runs of this user that fly now, the newest first."""
    found = []
    for place in places():
        if not _is_ours(place):
            continue
        for path in place.glob("*.json"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                begun = path.stat().st_mtime_ns
                if (run := _read(path)) is not None:
                    found.append((begun, run))
    return [run for _, run in sorted(found, reverse=True)]


def _write(place: Path, run: Path) -> tuple[Path, int]:
    """Make the file, locked from the moment that it has its name."""
    place.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
    if not _is_ours(place):
        raise PermissionError(f"{place} is not this user's alone")
    path = place / f"{os.getpid()}-{secrets.token_hex(4)}.json"
    new = path.with_suffix(".new")
    lock = os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        os.write(lock, json.dumps({"schemaVersion": 1, "run": str(run.resolve())}).encode() + b"\n")
        new.rename(path)
    except OSError:
        os.close(lock)
        new.unlink(missing_ok=True)
        raise
    return path, lock


def _read(path: Path) -> Path | None:
    """Read where a flight is; None if it is over, and then its file is taken away."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return Path(json.loads(file.read())["run"])
    path.unlink(missing_ok=True)
    return None


def _is_ours(place: Path) -> bool:
    """Say whether it is a folder that nobody else can put anything into."""
    try:
        state = place.stat()
    except OSError:
        return False
    return state.st_uid == os.getuid() and not state.st_mode & 0o077
