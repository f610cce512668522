"""Flights under way on this machine: each says where it is, so that its operator need not know.

A small file per flight, in a folder that is this user's alone: what stands in it is believed, which
a run's folder, that may have come from anywhere, is not. It is locked for as long as the flight
lasts: what a killed one has left behind is known by that, and taken away.
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
def announced(run: Path, api: str = "") -> Iterator[bool]:
    """Tell of the flight of a run's folder for as long as the block lasts; say whether it is told.

    Where no such file can be written it flies all the same.

    Args:
        run: Its folder.
        api: Address of its operator's API; "" without one.
    """
    path, lock = None, -1
    for place in places():
        with contextlib.suppress(OSError):
            path, lock = _write(place, run, api)
            break
    try:
        yield path is not None
    finally:
        if path is not None:
            with contextlib.suppress(OSError):
                path.unlink()
            os.close(lock)


def under_way() -> dict[Path, str]:
    """Folders of the runs of this user that fly now, the newest first, with their APIs' addresses.

    A run without an API has "" there.
    """
    found = []
    for place in places():
        if not _is_ours(place):
            continue
        for path in place.glob("*.json"):
            with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
                begun = path.stat().st_mtime_ns
                if _is_ours(path) and (flight := _read(path)) is not None:
                    found.append((begun, *flight))
    return {run: api for _, run, api in sorted(found, reverse=True)}


def _write(place: Path, run: Path, api: str) -> tuple[Path, int]:
    """Make the file, locked from the moment that it has its name."""
    place.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
    if not _is_ours(place):
        raise PermissionError(f"{place} is not this user's alone")
    path = place / f"{os.getpid()}-{secrets.token_hex(4)}.json"
    new = path.with_suffix(".new")
    lock = os.open(new, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        told = {"schemaVersion": 1, "run": str(run.resolve()), "api": api}
        os.write(lock, json.dumps(told).encode() + b"\n")
        new.rename(path)
    except OSError:
        os.close(lock)
        new.unlink(missing_ok=True)
        raise
    return path, lock


def _read(path: Path) -> tuple[Path, str] | None:
    """Read where a flight and its API are; None if it is over: then its file is taken away."""
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            told = json.loads(file.read())
            return Path(told["run"]), str(told.get("api", ""))
    path.unlink(missing_ok=True)
    return None


def _is_ours(place: Path) -> bool:
    """Say whether it is this user's, and nobody else can look into it or write to it."""
    try:
        state = place.stat()
    except OSError:
        return False
    return state.st_uid == os.getuid() and not state.st_mode & 0o077
