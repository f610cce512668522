# SPDX-License-Identifier: Apache-2.0

"""Run and supervise the robots of a fleet on this machine, and the cell that they share."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path

from cloudrc.base.files import write_atomically
from cloudrc.flight.local.places import LINK_FOLDER, ROUTE_FILE, RobotProcesses
from cloudrc.flight.local.supervisor import RECEIVERS, LocalRun
from cloudrc.flight.pod.realtime import free_ports
from cloudrc.wire.records import Record

START_FILE = "start"
"""The file from which a robot's cloud reads where to send, once the fleet may start."""
CELL_FILE = "cell.csv"
"""File in the folder of a fleet: what the cell did."""


class LocalFleet(LocalRun):
    """Runs and supervises the processes of all robots, and of the cell.

    The missions start together: no cloud knows where to send until all processes are ready. After
    its mission, a robot flies on and sends until all missions are over.
    """

    def __init__(
        self,
        folder: Path,
        robots: Mapping[int, Path],
        see: Callable[[list[Record]], None],
        *,
        cell: bool,
    ) -> None:
        """Prepare a run in `folder`, which contains config.yaml; start no process yet.

        `robots` are number and folder of each robot, as for a `LocalRun`. Without a `cell`, each
        has a link of its own.
        """
        super().__init__(folder, see)
        self._robots, self._cell = robots, cell

    def _fly(self, limit: float, files: ExitStack) -> None:
        first = dict(zip(RECEIVERS, free_ports(4, max(self._robots) + 1), strict=True))
        robots = list[RobotProcesses]()
        for number, folder in self._robots.items():
            at = {name: f"127.0.0.1:{port + number}" for name, port in first.items()}
            robots.append(self._open(folder, at, files))
            if self._cell:
                _write(folder, "uplink", ROUTE_FILE, at["uplink"])
                _write(folder, "downlink", ROUTE_FILE, at["downlink"])
            self._start_end(robots[-1], "world", ROUTE_FILE)
            self._start_teleop(robots[-1])
        self._wait_until_ready()
        if self._cell:
            self._start_cell({name: f"127.0.0.1:{port}" for name, port in first.items()})
        else:
            origin_ns = time.monotonic_ns()
            for robot in robots:
                self._start_links(robot, origin_ns)
        self._wait_until_ready()
        for robot in robots:  # last: after 5 s, a cloud complains that world is silent
            self._start_end(robot, "cloud", START_FILE, teleop=robot.sockets)
        self._wait_until_ready()
        for robot in robots:
            route = robot.folder / LINK_FOLDER / "downlink" / ROUTE_FILE
            _write(robot.folder, "downlink", START_FILE, route.read_text(encoding="ascii"))
        self._watch(limit, self._folder)

    def _start_cell(self, first: Mapping[str, str]) -> None:
        """Start the cell; `first` are the addresses of robot 0."""
        ways = {"uplink": first["uplink"], "downlink": first["downlink"]}
        ends = {"worlds": first["world"], "clouds": first["cloud"]}
        count, record = max(self._robots) + 1, self._folder / CELL_FILE
        words = "process", "cell"
        self._start(self._folder, "cell", *words, robots=count, record=record, **ways, **ends)


def _write(folder: Path, way: str, name: str, address: str) -> None:
    write_atomically(folder / LINK_FOLDER / way / name, address.encode("ascii"))
