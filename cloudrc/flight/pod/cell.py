# SPDX-License-Identifier: Apache-2.0

"""Run the radio cell of a fleet as a process: the packets of all robots pass through it.

Each world and each cloud sends to a port of its own, which names the robot. The process records
what the cell does, as the file cell.csv of a fleet in virtual time.
"""

from __future__ import annotations

import json
import socket
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from ipaddress import ip_address
from itertools import cycle
from math import inf
from pathlib import Path
from typing import TextIO, TypeAlias

from cloudrc.base.text import csv_table
from cloudrc.config.load import read_experiment, robot_settings
from cloudrc.config.problems import problem_at
from cloudrc.config.resolved import ResolvedExperiment
from cloudrc.flight.assembly.link import build_cells, build_links
from cloudrc.flight.pod.exporter import Exporter
from cloudrc.flight.pod.ports import ipv4_addresses, listening, open_exporter, repeat, warn
from cloudrc.flight.pod.process import Feed, StopSignal
from cloudrc.flight.pod.realtime import Address, bind
from cloudrc.link.carry.cell import CellEngine, CellPort
from cloudrc.link.carry.engine import LinkWay
from cloudrc.link.carry.log import PacketLog
from cloudrc.link.carry.punctual import ask_for_fifo, settle
from cloudrc.link.carry.udp import Entrance, Exit
from cloudrc.link.cell import Cell
from cloudrc.link.follow import PEER_PAUSE, PeerName
from cloudrc.link.profile import DIRECTIONS
from cloudrc.wire.tunnel.codec import peek

PERIOD_NS = 100_000_000
"""Time of a row of the recording [ns]."""
AT_ONCE = 10
"""Largest number of names that are resolved within a pause of `PEER_PAUSE`."""
log = partial(warn, process="cell")
WayOut: TypeAlias = tuple[Address, Exit, list[LinkWay]]
"""Where packets of a direction go, what sends them there, and both directions of the robot."""


@dataclass(frozen=True)
class CellSettings:
    """Files and addresses of the process; a field is the flag of this name.

    Robot k's world sends to the port `uplink` + k, its cloud to the port `downlink` + k.
    """

    config: Path  # experiment file of the fleet
    uplink: Address  # where to receive what worlds send
    downlink: Address  # where to receive what clouds send
    worlds: Address  # where to send the downlink, see `address_of`
    clouds: Address  # where to send the uplink
    record: Path  # CSV file
    robots: int | None = None  # number of robots; None: that of the experiment
    record_max: float | None = None  # size at which `record` begins anew [bytes]
    feed: bool = False  # write status for a supervisor to stdout
    metrics: Address | None = None  # serve metrics here


def run_cell(settings: CellSettings, stop: StopSignal) -> None:
    """Carry the packets of a fleet until `stop`."""
    feed = Feed.on_stdout(watched=settings.feed)
    experiment = read_experiment(str(settings.config))
    if experiment.cell.rate_kbit is None:
        raise problem_at("cell.rate_kbit", "the process 'cell' needs a rate, such as 1000")
    exporter = open_exporter("cell", experiment, settings.metrics)
    with ExitStack() as opened:
        count = settings.robots or experiment.fleet.robots
        engine, cells, exits = _open(settings, experiment, count, opened)
        _follow(exits)
        file = opened.enter_context(settings.record.open("w", encoding="utf-8", newline=""))
        settle()
        if ask_for_fifo():
            log("the cell runs under SCHED_FIFO")
        if exporter:
            exporter.cell.expect(count)
        limit = settings.record_max or inf
        _carry(engine, cells, feed.alive_while(stop), file, exporter, limit)
        log(json.dumps(engine.counts() | engine.errors.in_ns()))


def address_of(peers: Address, robot: int) -> Address:
    """Return the address of a robot's world or cloud.

    It is `peers` with the number in place of {robot} in its host; without {robot}, the number is
    added to the port.
    """
    host, port = peers
    return (
        (host.replace("{robot}", str(robot)), port) if "{robot}" in host else (host, port + robot)
    )


def _open(
    settings: CellSettings, experiment: ResolvedExperiment, count: int, opened: ExitStack
) -> tuple[CellEngine, list[Cell], list[WayOut]]:
    """Open the sockets of `count` robots; return what carries, the cells, and where to send."""
    origin_ns = time.monotonic_ns()
    cells = build_cells(experiment, origin_ns)
    outside = opened.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    outside.setblocking(False)
    port = CellPort(cells)
    engine, exits = CellEngine(port, cells), list[WayOut]()
    for robot in range(count):
        own = read_experiment(str(settings.config), robot_settings(robot))
        ways = list[LinkWay]()
        for name, to, link in zip(
            DIRECTIONS,
            (settings.clouds, settings.worlds),
            build_links(own, origin_ns),
            strict=True,
        ):
            host, first = getattr(settings, name)
            leave = Exit(outside)
            exits.append((address_of(to, robot), leave, ways))
            ways.append(LinkWay(link, leave, PacketLog(0)))
            with listening(f"--{name}", (host, first + robot)):
                one = opened.enter_context(bind((host, first + robot)))
            port.add(one, Entrance(one, ways[-1], peek))
        engine.join(robot, (ways[0], ways[1]), (own.uplink.keep_order, own.downlink.keep_order))
    return engine, cells, exits


def _follow(exits: Sequence[WayOut]) -> None:
    """Resolve the names of all peers again and again, one after the other.

    A robot that has sent nothing may not exist: it takes seconds to learn that a name is unknown.
    """
    names = list[tuple[PeerName, Exit, list[LinkWay]]]()
    for address, leave, ways in exits:
        if _is_number(address[0]):
            leave.peer = address
        else:
            names.append((PeerName(address, ipv4_addresses, log), leave, ways))
    turns = cycle(names)

    def resolve_next() -> None:
        name, leave, ways = next(turns)
        if any(way.received for way in ways):
            leave.peer = name.poll() or leave.peer

    if names:
        repeat(resolve_next, *(pause / AT_ONCE for pause in PEER_PAUSE))


def _is_number(host: str) -> bool:
    try:
        ip_address(host)
    except ValueError:
        return False
    return True


def _carry(
    engine: CellEngine,
    cells: Sequence[Cell],
    stop: Callable[[], bool],
    file: TextIO,
    exporter: Exporter | None,
    record_max: float,
) -> None:
    """Carry packets until `stop()`; record each `PERIOD_NS` in which a packet has left.

    At a size of `record_max` [bytes] the record begins anew.
    """
    until_ns, start_ns = time.monotonic_ns(), 0
    while not stop():
        until_ns += PERIOD_NS
        while (rest_ns := until_ns - time.monotonic_ns()) > 0:
            engine.step(rest_ns * 1e-9)
        if not start_ns and engine.counts()["received"]:
            start_ns = until_ns - PERIOD_NS
        done = [cell.end_period(until_ns - start_ns) for cell in cells]
        if any(each.packets for each in done):
            if file.tell() > record_max:
                file.seek(0)
                file.truncate()
            lines = csv_table([each.row() for each in done]).split("\n", 1)
            file.write(f"{lines[0]}\n" * (not file.tell()) + f"{lines[1]}\n")
            file.flush()
        if exporter:
            exporter.cell.take(done)
            exporter.ready(True)
