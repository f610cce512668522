# SPDX-License-Identifier: Apache-2.0

"""The flights of this user that are under way: a locked file for each, in a private folder.

During a flight, its file names the folder of the run and the address of the operator's API.
Commands trust the flight file, but not the folder of the run, which may come from somebody else.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import logging
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from cloudrc.base.files import make_own_folder, try_lock, who_may_write

JOURNAL_FILE = "missions.journal"
"""File in a session's folder: teleop's store of the missions."""
RUN, SESSION, LINK = "run", "session", "link"
"""Kinds of flights: a run (`cloudrc run`) ends with its mission, a session with `cloudrc down`. A
link between two programs (`cloudrc link exec`) is no flight, but commands find it in the same way.
"""


def flights_folder() -> Path | None:
    """Return the folder for flight files, which tell other commands about flights under way.

    It is the first of these in which only this user can write: one in XDG_RUNTIME_DIR, one in the
    home folder, one below /tmp. Otherwise other users could name any process and address. None if
    there is no such folder, as in a pod.

    Source: XDG Base Directory Specification.
    """
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    is_own = os.path.isdir(runtime) and not who_may_write(Path(runtime))
    homes = os.path.expanduser("~/.local/state"), f"/tmp/cloudrc-{os.geteuid()}"
    for root in filter(os.path.isabs, (runtime if is_own else "", *homes)):
        folder = Path(root, "cloudrc", "flights")
        try:
            if not make_own_folder(folder) and os.access(folder, os.W_OK):
                return folder
        except OSError:  # it cannot be made
            continue
    return None


class FlightFile(NamedTuple):
    """What a flight file tells other commands about a flight, besides the folder of the run."""

    api: str  # address of the operator's API
    kind: str  # RUN, SESSION or LINK
    pid: int  # process id of the supervisor


@contextlib.contextmanager
def announced(run: Path, api: str, kind: str = RUN) -> Iterator[None]:
    """Keep a flight file during the `with` block.

    The file tells other commands `run`, the folder of the run; `api`, the address of the operator's
    API; and `kind`, RUN, SESSION or LINK.
    """
    about = FlightFile(api, kind, os.getpid())._asdict()
    flight = json.dumps({"schemaVersion": 1, "run": str(run.resolve()), **about})
    folder = flights_folder()
    if folder is None:
        text = "other commands do not find this flight: no folder is for this user alone"
        logging.getLogger("cloudrc").warning("%s; set XDG_RUNTIME_DIR", text)
        yield
        return
    path = folder / f"{os.getpid()}-{secrets.token_hex(4)}.json"
    new = path.with_suffix(".new")  # renamed after it is locked
    try:
        new.touch(0o600)
        with new.open("wb", buffering=0) as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            file.write(flight.encode())
            new.rename(path)
            yield
    finally:
        for name in (path, new):
            name.unlink(missing_ok=True)


def under_way(*, links: bool = False) -> dict[Path, str]:
    """Return the flights of this user: folder of the run -> address of its API.

    With `links`, also return the links between two programs, which have no API.
    """
    return {
        run: flight.api for run, flight in flight_files().items() if links or flight.kind != LINK
    }


def flight_files() -> dict[Path, FlightFile]:
    """Return the flights of this user under way: folder of the run -> its flight file."""
    found = dict[Path, FlightFile]()
    folder = flights_folder()
    for path in folder.glob("*.json") if folder else ():
        with contextlib.suppress(FileNotFoundError), path.open() as file:  # it has just ended
            flight = json.load(file)
            if try_lock(file, shared=True):  # the process of this flight was killed
                path.unlink()
            else:
                about = FlightFile(flight["api"], flight["kind"], flight["pid"])
                found[Path(flight["run"])] = about
    return found
