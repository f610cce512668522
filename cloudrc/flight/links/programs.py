# SPDX-License-Identifier: Apache-2.0

"""Run two programs with the emulated link between them, and judge the link at the end."""

from __future__ import annotations

import contextlib
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.base.errors import (
    InterruptedRunError,
    InvalidRunError,
    MissingPrerequisiteError,
    TimedOutError,
)
from cloudrc.flight.links.carrier import STEP, CarrySettings, LiveLink, Tell
from cloudrc.flight.links.namespaces import Forwarder, ProgramEnd, ProgramState, print_lines
from cloudrc.flight.pod.realtime import show_address
from cloudrc.link.carry.engine import Engine
from cloudrc.link.carry.punctual import ask_for_fifo, settle
from cloudrc.link.carry.tun import IN_FLIGHT_MAX, TunPort, write_packet
from cloudrc.link.exec.listening import is_loopback
from cloudrc.link.exec.namespace import ADDRESSES
from cloudrc.link.queue import NOTHING_NS

if TYPE_CHECKING:
    from cloudrc.flight.pod.exporter import Exporter

LOOK_PERIOD = 0.05  # between two looks at the programs [s]
COUNT_PERIOD = 1.0  # between two updates of the metrics [s]
DRAIN_LIMIT = 1.0  # for the packets in flight at the end [s]
FLOWS = {"uplink": ("client", "server"), "downlink": ("server", "client")}
"""Direction -> the end that sends, and the end that receives."""
OUTPUT_LIMIT = 2.0  # for the last lines of a program, which may have to be killed [s]


@dataclass(frozen=True)
class ExecSettings(CarrySettings):
    """What to run; a field is the flag of this name."""

    server: str  # command for the shell
    client: str  # command for the shell
    expose: Sequence[int]  # ports of the server that this machine can reach
    wait: float  # longest time for the server to listen [s]; 0: the client starts at once
    metrics_port: int | None
    output: Path | None  # folder for the report and the recording


@dataclass(frozen=True)
class ExecOutcome:
    """How the two programs ended."""

    code: int  # exit code of the command
    codes: Mapping[str, int | None]  # exit code of each program; None if it was ended
    interrupted: bool


def run_programs(settings: ExecSettings, tell: Tell) -> tuple[ExecOutcome, LiveLink]:
    """Run both programs until the client ends; return how they ended, and the link.

    Raises:
        CloudrcError: If the link or a program cannot start.
    """
    with contextlib.ExitStack() as stack:
        link = LiveLink(settings, "link exec", tell, stack, output=settings.output)
        run = _Run(link, tell, stack)
        run.open_ends()
        commands = run.fill_in({"server": settings.server, "client": settings.client})
        if settings.metrics_port is not None:
            run.serve_metrics(settings.metrics_port)
        for port in settings.expose:
            stack.callback(Forwarder(run.ends["server"], port).close)
            tell(f"127.0.0.1:{port} leads to the server's port {port}, beside the link")
        outcome = run.run(commands, settings.wait)
    return outcome, link


class _EngineThread(threading.Thread):
    """Carries packets; `failure` says why it has stopped, "" while it works."""

    def __init__(self, engine: Engine) -> None:
        super().__init__(daemon=True)
        self._engine, self._stopping, self.failure = engine, False, ""
        self.start()

    def run(self) -> None:
        settle()
        ask_for_fifo()
        try:
            while not self._stopping:
                self._engine.step(STEP)
        except Exception as error:
            self.failure = f"{type(error).__name__}: {error}"

    def drain(self) -> None:
        """Wait until the packets in flight have arrived, at most `DRAIN_LIMIT`."""
        deadline = time.monotonic() + DRAIN_LIMIT
        while self._engine.queue.next_ns != NOTHING_NS and time.monotonic() < deadline:
            time.sleep(0.005)

    def close(self) -> None:
        """Stop; packets in flight are lost."""
        self._stopping = True
        self.join()


class _Run:
    """The two ends with their programs."""

    def __init__(self, link: LiveLink, tell: Tell, stack: contextlib.ExitStack) -> None:
        self._link, self._tell, self._stack = link, tell, stack
        self.ends = dict[str, ProgramEnd]()
        self._exporter: Exporter | None = None
        self._printers = list[threading.Thread]()
        self._counted_at = 0.0

    def open_ends(self) -> None:
        """Make both namespaces, and print what their programs write."""
        self._stack.callback(self._close_ends)
        for name in ADDRESSES:
            end = self.ends[name] = ProgramEnd(name, reads_stdin=name == "client")
            for source, target in zip(end.outputs, (sys.stdout, sys.stderr), strict=True):
                self._printers.append(print_lines(source, target.buffer, f"[{name}] "))

    def _close_ends(self) -> None:
        for end in self.ends.values():  # both at once
            end.hang_up()
        for printer in self._printers:
            printer.join(OUTPUT_LIMIT)
        for end in self.ends.values():
            end.close()

    def fill_in(self, commands: Mapping[str, str]) -> dict[str, str]:
        """Replace {server}, {client}, {server6} and {client6} in commands by addresses."""
        filled = {}
        for name, command in commands.items():
            for end, addresses in ADDRESSES.items():
                if f"{{{end}6}}" in command and not self.ends[end].has_ipv6:
                    raise MissingPrerequisiteError(
                        f"--{name}: {{{end}6}} needs IPv6, which is off on this machine; use"
                        f" {{{end}}}"
                    )
                command = command.replace(f"{{{end}6}}", addresses.ipv6)
                command = command.replace(f"{{{end}}}", addresses.ipv4)
            filled[name] = command
        return filled

    def serve_metrics(self, port: int) -> None:
        """Serve the link's metrics on a port of this machine."""
        from cloudrc.flight.pod.exporter import Exporter

        exporter = self._exporter = Exporter("link")
        exporter.link.tell = self._link.status_page
        exporter.serve(("127.0.0.1", port))
        self._link.export = exporter.shaped
        self._stack.callback(exporter.close)

    def run(self, commands: Mapping[str, str], wait: float) -> ExecOutcome:
        """Start the server, then the client; return when one of them has ended the run."""
        client, server = self.ends["client"], self.ends["server"]
        try:
            server.run(commands["server"])
            if (code := self._wait_for_server(server, wait)) is not None:
                return ExecOutcome(code, {"server": code, "client": None}, interrupted=False)
            carrier = self._start_link()
            places = [
                addresses.ipv4 + f" and {addresses.ipv6}" * client.has_ipv6
                for addresses in ADDRESSES.values()
            ]
            about = f"{self._link.cause}, seed {self._link.seed}, by {client.way}"
            self._tell(f"link: {about}; client {places[0]}, server {places[1]}")
            client.run(commands["client"])
            return self._supervise(carrier)
        except KeyboardInterrupt:
            return ExecOutcome(InterruptedRunError.exit_code, {}, interrupted=True)

    def _start_link(self) -> _EngineThread:
        """Carry packets between the devices of both ends; the schedule begins."""
        link, devices = self._link, {name: end.device for name, end in self.ends.items()}
        link.carry({way: partial(write_packet, devices[to]) for way, (_, to) in FLOWS.items()})
        port = TunPort({devices[one]: link.ways[way] for way, (one, _) in FLOWS.items()})
        engine = Engine(port, list(link.ways.values()), IN_FLIGHT_MAX)
        port.drain()
        link.serve(engine)
        carrier = _EngineThread(engine)
        self._stack.callback(carrier.close)
        return carrier

    def _wait_for_server(self, server: ProgramEnd, limit: float) -> int | None:
        """Wait until other namespaces can reach the server; return its exit code if it ends."""
        deadline, why = time.monotonic() + limit, "it listens at no port"
        while time.monotonic() < deadline:
            state = server.state()
            if state.code is not None and (state.code or not state.lives):
                hint = "" if state.code else "; --wait 0 starts the client without a server"
                self._tell(f"the server ended with exit code {state.code} before it listened{hint}")
                return state.code or InvalidRunError.exit_code
            if not all(is_loopback(host) for host, _ in state.listens):
                return None
            if state.listens:
                places = ", ".join(sorted({show_address(place) for place in state.listens}))
                why = f"the server listens only at {places}, let it listen at 0.0.0.0"
            time.sleep(LOOK_PERIOD)
        if limit:
            raise TimedOutError(
                f"no client can reach the server after {limit:g} s: {why}; --wait S waits longer,"
                " --wait 0 not at all"
            )
        return None

    def _supervise(self, carrier: _EngineThread) -> ExecOutcome:
        while True:
            states = {name: end.state() for name, end in self.ends.items()}
            codes = {name: state.code for name, state in states.items()}
            self._count(states)
            if carrier.failure:
                raise InvalidRunError(f"the relay has failed: {carrier.failure}; report it")
            if (code := codes["client"]) is not None:
                carrier.drain()
                return ExecOutcome(code, codes, interrupted=False)
            if code := codes["server"]:
                self._tell(f"the server ended with exit code {code}; the client is ended")
                return ExecOutcome(code, codes, interrupted=False)
            time.sleep(LOOK_PERIOD)

    def _count(self, states: Mapping[str, ProgramState]) -> None:
        """Note the packets that the devices dropped; update the metrics once a second."""
        for name, (sender, _) in FLOWS.items():
            self._link.unread[name] = states[sender].dropped
        now = time.monotonic()
        if self._exporter and now - self._counted_at >= COUNT_PERIOD:
            self._counted_at = now
            self._exporter.counted(self._link.counts())
