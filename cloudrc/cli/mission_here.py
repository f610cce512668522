"""Which run on this machine `cloudrc mission` means: flags come in, its API's URL goes out."""

from __future__ import annotations

import argparse
import json
import socket
import sys
from pathlib import Path
from urllib.parse import urlsplit

from cloudrc.errors import BadInputError

KUBECTL_PLUGIN = "kubectl-cloudrc"
"""What this program is called when kubectl starts it."""
CONNECT_LIMIT = 1.0
"""For the API of a run on this machine to take a connection [s]."""


def run_argument(parser: argparse.ArgumentParser) -> None:
    """Declare the flag."""
    parser.add_argument("--run", type=Path, metavar="DIR", help="folder of a run that flies here")


def url_here(options: argparse.Namespace) -> str | None:
    """Find the API of the run that flies here, unless a cluster is meant.

    That of ./runs/latest comes first, then the only other one of this user, wherever it was
    started.

    Raises:
        BadInputError: If there are several others, or none where the flag says.
    """
    in_cluster = options.context or options.namespace or options.release
    if options.run is not None:
        return _url_asked_for(options.run, in_cluster=bool(in_cluster))
    if in_cluster or Path(sys.argv[0]).name.startswith(KUBECTL_PLUGIN):
        return None
    from cloudrc.cli.folder import RUNS
    from cloudrc.drivers.flights import under_way

    if (url := _url(RUNS / "latest")) is not None:
        return url
    found = [(run, url) for run in under_way() if (url := _url(run)) is not None]
    if len(found) > 1:
        names = " or ".join(f"--run {run}" for run, _ in found)
        raise BadInputError(f"{len(found)} runs fly here; say which: {names}")
    if not found:
        return None
    ((run, url),) = found
    print(f"cloudrc: the run that flies in {run}", file=sys.stderr, flush=True)
    return url


def _url_asked_for(run: Path, *, in_cluster: bool) -> str:
    if in_cluster:
        raise BadInputError("--run names a run here, the other flags a cluster; give one")
    url = _url(run)
    if url is None:
        raise BadInputError(
            f"--run {run}: no run with an API flies there; name another folder, or --api URL"
        )
    return url


def _url(run: Path) -> str | None:
    """Where the API of the run in this folder is; None if none flies there."""
    from cloudrc.drivers.local import API_FILE

    try:
        url = str(json.loads((run / API_FILE).read_text(encoding="utf-8"))["url"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return None if _is_gone(url) else url


def _is_gone(url: str) -> bool:
    """Say whether nobody listens: a run that was killed leaves its file behind."""
    from cloudrc.cli.mission_http import UNIX

    try:
        if url.startswith(UNIX):
            with socket.socket(socket.AF_UNIX) as listening:
                listening.settimeout(CONNECT_LIMIT)
                listening.connect(url.removeprefix(UNIX))
        else:
            parts = urlsplit(url)
            where = parts.hostname or "", parts.port or 0
            socket.create_connection(where, CONNECT_LIMIT).close()
    except (ConnectionRefusedError, FileNotFoundError):
        return True
    except (OSError, ValueError):
        return False  # whatever it is, the verb itself says it better
    return False
