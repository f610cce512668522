# SPDX-License-Identifier: Apache-2.0

"""Open the ports of a process, and warn if other machines can reach them; repeat an action."""

from __future__ import annotations

import os
import random
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from cloudrc.base.files import at_place
from cloudrc.base.text import escape
from cloudrc.config.resolved import ResolvedExperiment, fingerprint
from cloudrc.flight.pod.realtime import Address, show_address

if TYPE_CHECKING:
    from cloudrc.flight.pod.exporter import Exporter

IN_POD = "KUBERNETES_SERVICE_HOST"
"""Environment variable that Kubernetes sets in each container of a pod."""


def warn(text: str, process: str = "") -> None:
    """Write a line to stderr, the log of a process, from any thread."""
    print(escape(f"cloudrc{process and ' '}{process}: {text}"), file=sys.stderr, flush=True)


def ipv4_addresses(name: str) -> list[str]:
    """Return the IPv4 addresses of a host name; relay and netem shape IPv4 only.

    Raise an OSError if there is none.
    """
    try:
        found = socket.getaddrinfo(name, None, socket.AF_INET, socket.SOCK_DGRAM)
    except UnicodeError as error:  # an empty label, or one that is too long
        raise OSError(f"not a name: {error}") from error
    return [str(entry[4][0]) for entry in found]


def warn_if_exposed(listen: Address) -> None:
    """Print a warning if other machines can send to `listen`; in a pod, that is the purpose."""
    if IN_POD in os.environ:
        return
    if not listen[0].startswith("127.") and listen[0] not in ("localhost", "::1"):
        warn(f"warning: {listen[0]} can be reached from outside")


def repeat(action: Callable[[], None], shortest: float, longest: float) -> None:
    """Repeat an action on a thread, with random pauses from `shortest` to `longest` [s]."""

    def work() -> None:
        while True:
            action()
            time.sleep(random.uniform(shortest, longest))

    threading.Thread(target=work, daemon=True).start()


@contextmanager
def listening(flag: str, listen: Address) -> Iterator[None]:
    """Warn if other machines can reach `listen`; an OSError names it and its `flag`."""
    warn_if_exposed(listen)
    with at_place(f"{flag} {show_address(listen)}"):
        yield


def open_exporter(
    role: str, experiment: ResolvedExperiment, where: Address | None
) -> Exporter | None:
    """Serve the metrics of this process at an address; return None without an address."""
    if where is None:
        return None
    from cloudrc.flight.pod.exporter import Exporter

    warn_if_exposed(where)
    exporter = Exporter(role, fingerprint(experiment))
    exporter.serve(where)
    return exporter
