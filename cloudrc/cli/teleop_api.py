"""The API of `cloudrc teleop`: its flags come in, a server goes out, with tokens and audit log."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.cli.ends import Address, address, warn_if_exposed
from cloudrc.cli.output import say

if TYPE_CHECKING:
    from collections.abc import Callable

    from cloudrc.config.load import ResolvedExperiment
    from cloudrc.records import Counted
    from cloudrc.teleop.auth import Audit
    from cloudrc.teleop.bridge import Bridge
    from cloudrc.teleop.server import ApiServer
    from cloudrc.teleop.service import MissionService

LOOPBACK = "127.0.0.1"
COUNT_PERIOD_NS = 1_000_000_000
"""Between two times that the API's counts become metrics [ns]."""


class ServedApi:
    """An API that answers; until it is opened only that teleop is not ready yet.

    Attributes:
        bridge: From its threads to teleop's loop.
    """

    def __init__(self, bridge: Bridge, server: ApiServer, audit: Audit) -> None:
        self.bridge, self._server, self._audit = bridge, server, audit
        self._service: MissionService | None = None
        self._counted_ns = 0

    def open(self, service: MissionService, alarm: Callable[[], object]) -> None:
        """Serve missions from now on.

        Args:
            service: Of them.
            alarm: Sends an emergency stop past the service; called from any thread.
        """
        self.bridge.alarm, self._service = alarm, service
        self.bridge.open(service)

    def counted(self) -> list[Counted]:
        """What was done with requests so far, once a second."""
        import time

        from cloudrc.records import Counted

        now_ns = time.monotonic_ns()
        if now_ns - self._counted_ns < COUNT_PERIOD_NS:
            return []
        self._counted_ns = now_ns
        counts = {**self._server.counts, "audit_dropped": self._audit.dropped}
        if self._service is not None:
            counts["events_dropped"] = self._service.book.dropped
        return [Counted(now_ns, "teleop", f"api_{name}", n) for name, n in sorted(counts.items())]

    def stop(self) -> None:
        """Answer what is asked, and end."""
        self._server.stop()
        self._audit.close()


def serve_api(options: argparse.Namespace, experiment: ResolvedExperiment) -> ServedApi:
    """Answer from now on, if only that teleop is not ready yet."""
    import json
    from functools import partial

    from cloudrc import assembly
    from cloudrc.geometry.scene import load_scene
    from cloudrc.link.state import publish
    from cloudrc.teleop.api import Surroundings, create_app
    from cloudrc.teleop.auth import Audit, Tokens
    from cloudrc.teleop.bridge import Bridge
    from cloudrc.teleop.server import ApiServer, Gate

    if not isinstance(options.api, Path):
        warn_if_exposed(options.api)
    criteria, bridge = experiment.criteria, Bridge()
    scene = load_scene(experiment.world.scene)
    plan = partial(assembly.mission_plan, speed_max=experiment.guard.speed_max_mps)
    surroundings = Surroundings(scene, criteria.time_limit_s, criteria.contact, plan)
    tokens = Tokens(options.tokens) if options.tokens else None
    audit = Audit(options.audit, complain)
    gate = Gate(create_app(bridge, surroundings), tokens, audit, complain=complain)
    server = ApiServer(gate, bridge, options.api)
    server.start()
    if options.api_file is not None:
        publish(options.api_file, json.dumps({"schemaVersion": 1, "url": server.url}) + "\n")
    return ServedApi(bridge, server, audit)


def complain(text: str) -> None:
    """Write a line into the process's log; from any thread."""
    say(f"cloudrc teleop: {text}", sys.stderr)


def api_address(text: str) -> Address | Path:
    """Read [HOST:]PORT, whose port may be 0, or unix:PATH."""
    if text.startswith("unix:") and len(text) > len("unix:"):
        return Path(text.removeprefix("unix:"))
    host, colon, port = text.rpartition(":")
    host = host if colon else LOOPBACK
    return (host, 0) if host and port == "0" else address(f"{host}:{port}")
