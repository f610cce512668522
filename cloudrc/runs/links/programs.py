"""Run two programs with the emulated link between them, and judge the link at the end."""

from __future__ import annotations

import contextlib
import re
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cloudrc.drivers.link_metrics import export_counts, export_state
from cloudrc.drivers.namespaces import Forwarder, ProgramEnd, ProgramState, print_lines
from cloudrc.drivers.realtime import show_address
from cloudrc.errors import (
    InterruptedRunError,
    InvalidRunError,
    MissingPrerequisiteError,
    TimedOutError,
)
from cloudrc.link.exec.listening import is_loopback
from cloudrc.link.exec.namespace import ADDRESSES
from cloudrc.runs.links.carrier import FLOWS, CarrySettings, ExecLink, Tell, open_live

if TYPE_CHECKING:
    from cloudrc.drivers.exporter import Exporter
    from cloudrc.link.state import LinkState

LOOK_PERIOD = 0.05  # between two looks at the programs [s]
COUNT_PERIOD = 1.0  # between two updates of the metrics [s]
PATIENCE = 3.0  # until the command says that it waits [s]
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


def run_programs(settings: ExecSettings, tell: Tell) -> tuple[ExecOutcome, ExecLink]:
    """Run both programs until the client ends; return how they ended, and the link.

    Raises:
        CloudrcError: If the link or a program cannot start.
    """
    with contextlib.ExitStack() as stack:
        live = open_live(settings, "link exec", tell, stack, output=settings.output)
        link = ExecLink(live, settings.seed)
        stack.callback(link.close)
        run = _Run(link, tell)
        run.open_ends(stack)
        commands = run.fill_in({"server": settings.server, "client": settings.client})
        if settings.metrics_port is not None:
            run.serve_metrics(settings.metrics_port, stack)
        for port in settings.expose:
            stack.callback(Forwarder(run.ends["server"], port).close)
            tell(f"127.0.0.1:{port} leads to the server's port {port}, beside the link")
        outcome = run.run(commands, settings.wait)
    return outcome, link


class _Run:
    """The two ends with their programs."""

    def __init__(self, link: ExecLink, tell: Tell) -> None:
        self._link, self._tell = link, tell
        self.ends = dict[str, ProgramEnd]()
        self._exporter: Exporter | None = None
        self._printers = list[threading.Thread]()
        self._counted_at = 0.0

    def open_ends(self, stack: contextlib.ExitStack) -> None:
        """Make both namespaces, and print what their programs write."""
        stack.callback(self._close_ends)
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
        filled = dict(commands)
        has_ipv6 = all(end.has_ipv6 for end in self.ends.values())
        for name, command in commands.items():
            for other, addresses in ADDRESSES.items():
                if f"{{{other}6}}" in command and not has_ipv6:
                    raise MissingPrerequisiteError(
                        f"--{name}: {{{other}6}} needs IPv6, which is off on this machine;"
                        f" use {{{other}}}"
                    )
                command = command.replace(f"{{{other}6}}", addresses.ipv6)
                command = command.replace(f"{{{other}}}", addresses.ipv4)
            filled[name] = command
        local = re.search(r"localhost|127\.0\.0\.1|\[?::1\b", commands["client"])
        if local and "{server" not in commands["client"]:
            self._tell(
                f"note: --client names {local[0]}, where the server is not; write {{server}} for"
                " its address"
            )
        return filled

    def serve_metrics(self, port: int, stack: contextlib.ExitStack) -> None:
        """Serve the link's metrics on a port of this machine."""
        from cloudrc.drivers.exporter import Exporter

        exporter = self._exporter = Exporter("link")
        exporter.link.tell = self._link.live.status_page
        exporter.serve(("127.0.0.1", port))
        stack.callback(exporter.close)

    def run(self, commands: Mapping[str, str], wait: float) -> ExecOutcome:
        """Start the server, then the client; return when one of them has ended the run."""
        client, server = self.ends["client"], self.ends["server"]
        try:
            server.run(commands["server"])
            if (code := self._wait_for_server(server, wait)) is not None:
                return ExecOutcome(code, {"server": code, "client": None}, interrupted=False)
            self._link.start(
                {name: end.take_device() for name, end in self.ends.items()}, self._changed
            )
            self._tell(_describe(self._link, client))
            client.run(commands["client"])
            return self._supervise()
        except KeyboardInterrupt:
            return ExecOutcome(InterruptedRunError.exit_code, {}, interrupted=True)

    def _wait_for_server(self, server: ProgramEnd, limit: float) -> int | None:
        """Wait until other namespaces can reach the server; return its exit code if it ends."""
        began, told = time.monotonic(), False
        while (waited := time.monotonic() - began) < limit:
            state = server.state()
            if state.code is not None and (state.code or not state.lives):
                hint = "" if state.code else "; --wait 0 starts the client without a server"
                self._tell(f"the server ended with exit code {state.code} before it listened{hint}")
                return state.code or InvalidRunError.exit_code
            if not all(is_loopback(host) for host, _ in state.listens):
                return None
            if waited > PATIENCE and not told:
                told = True
                why = f"; {_only_loopback(state)}" if state.listens else ""
                self._tell(f"waits up to {limit:g} s (--wait) until the server listens{why}")
            time.sleep(LOOK_PERIOD)
        if limit:
            why = _only_loopback(state) if state.listens else "it listens at no port"
            raise TimedOutError(
                f"no client can reach the server after {limit:g} s: {why}; --wait S waits longer,"
                " --wait 0 not at all"
            )
        return None

    def _supervise(self) -> ExecOutcome:
        while True:
            states = {name: end.state() for name, end in self.ends.items()}
            codes = {name: state.code for name, state in states.items()}
            self._count(states)
            if self._link.failure:
                raise InvalidRunError(f"the relay has failed: {self._link.failure}; report it")
            if (code := codes["client"]) is not None:
                self._link.wait_until_empty()
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
            export_counts(self._exporter, self._link.counts())

    def _changed(self, state: LinkState, news: str) -> None:
        if news:
            self._tell(news)
        export_state(self._exporter, state)


def _describe(link: ExecLink, end: ProgramEnd) -> str:
    way = f"by {end.way}"
    client, server = (
        addresses.ipv4 + (f" and {addresses.ipv6}" if end.has_ipv6 else "")
        for addresses in (ADDRESSES["client"], ADDRESSES["server"])
    )
    return f"link: {link.live.cause}, seed {link.seed}, {way}; client {client}, server {server}"


def _only_loopback(state: ProgramState) -> str:
    places = ", ".join(sorted({show_address(place) for place in state.listens}))
    return f"the server listens only at {places}, let it listen at 0.0.0.0"
