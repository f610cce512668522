# SPDX-License-Identifier: Apache-2.0

"""Run and supervise world, teleop, cloud and the two directions of the link on this machine.

Each of these five is a process. The supervisor (this process) reads the records that they print. It
ends them when teleop ends after the mission, when one of them dies or hangs, or when the user
interrupts.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from cloudrc.base.errors import ControllerLostError, InvalidRunError, TimedOutError
from cloudrc.config.faults import FaultConfig
from cloudrc.flight.local.children import CONTROLLER, Child, start_process
from cloudrc.flight.local.faults import SignalledFaults
from cloudrc.flight.local.places import (
    API_FILE,
    LINK_FOLDER,
    ROUTE_FILE,
    RobotProcesses,
    link_socket,
    link_words,
    socket_folder,
)
from cloudrc.flight.machine import AwakeClock, await_or_kill
from cloudrc.flight.pod.realtime import free_ports
from cloudrc.link.state import STATE_FILE
from cloudrc.results.under_way import (
    JOURNAL_FILE,
    RUN,
    SESSION,
    announced,
    flight_files,
)
from cloudrc.wire.records import CONTROLLER_LOST, Fault, Record
from cloudrc.wire.tunnel.keys import KEY_SIZE, Key, KeySet, write

START_LIMIT = 60.0
"""Time limit for a process to become ready [s]; the first start reads some 100 MB from disk."""
STOP_LIMIT = 1.5
"""Time limit for a process to end after SIGTERM [s]; then the process is killed."""
SILENCE_LIMIT = 5.0
"""Time after the last printed line at which a process counts as hung [s]. Every process prints a
line at least once a second."""
PAUSE = 1.0
"""Longest turn of the supervisor's loop [s]. A longer turn means that the supervisor was paused; it
does not count for time limits."""
RECEIVERS = ("world", "cloud", "uplink", "downlink")
"""Processes that receive datagrams."""


def end_session(run: Path, limit: float) -> None:
    """End the session in the folder `run`, and wait until it has written its report.

    Raise a TimedOutError if this takes longer than `limit` [s].
    """
    deadline = time.monotonic() + limit
    if flight := flight_files().get(run):  # the file is locked, so `pid` is the supervisor
        os.kill(flight.pid, signal.SIGTERM)
    while run in flight_files():
        if time.monotonic() > deadline:
            raise TimedOutError(f"{run}: the session has not ended within {limit:g} s")
        time.sleep(0.05)


class LocalRun:
    """Runs and supervises the five processes of a flight.

    Attributes:
        notes: Sentences for the report of the flight.
        announcement: Its `close` deletes the file by which other commands find this run. `fly`
            closes it after a flight. After a session, the caller of `fly` has to close it.
    """

    def __init__(
        self,
        folder: Path,
        see: Callable[[list[Record]], None],
        session: Callable[[str, dict[str, str]], None] | None = None,
        *,
        remote: bool = False,
        lost: Callable[[list[Record]], None] = lambda records: None,
        gone: Callable[[], bool] = lambda: False,
        faults: Sequence[FaultConfig] = (),
    ) -> None:
        """Prepare a run in `folder`; start no process yet.

        `folder` contains config.yaml and, in `LINK_FOLDER`, profile.yaml and one folder per
        direction. The run writes world.mcap, cloud.mcap and five logs to `folder`. It calls `see`
        with the records that the processes print.

        If `session` is given, the run is a session: teleop waits for missions, all processes serve
        metrics, and the recordings contain only the flights. When all processes are ready,
        `session` gets the API's address and a mapping: process -> HOST:PORT of its metrics.

        With `remote`, a sixth process asks a controller outside. `lost` gets the same records as
        `see`, and raises a ControllerLostError if this controller is lost. `gone` returns whether
        the user's program beside the flight has ended. `faults` are those to inject.
        """
        self._remote, self._lost, self._gone = remote, lost, gone
        self._folder, self._see, self._session = folder, see, session
        self._metrics, self._faults = dict[str, str](), SignalledFaults(faults)
        self.announcement = contextlib.ExitStack()
        self._children: list[Child] = []
        self._selector = selectors.DefaultSelector()
        self._clock = AwakeClock(PAUSE)
        self.notes: tuple[str, ...] = ()

    def fly(self, limit: float) -> None:
        """Fly until the mission is over, at most `limit` [s]; then end all processes.

        Raises:
            InvalidRunError: If a process ends too early; the message names the process.
            TimedOutError: If the limit is reached, or if a process hangs; the message names it.
            KeyboardInterrupt: If the user interrupts.
        """
        with contextlib.ExitStack() as files:
            if not self._session:
                files.callback(self.announcement.close)
            try:
                self._fly(limit, files)
            finally:
                self._stop()

    def _fly(self, limit: float, files: contextlib.ExitStack) -> None:
        session = self._session
        ports = [f"127.0.0.1:{port}" for port in free_ports(9 if session else 4)]
        names = ("world", "cloud", "teleop", "uplink", "downlink")
        self._metrics = dict(zip(names, ports[4:], strict=False))
        robot = self._open(self._folder, dict(zip(RECEIVERS, ports, strict=False)), files)
        self._start_end(robot, "world", ROUTE_FILE)
        self._start_teleop(robot)
        self._wait_until_ready()
        # With cloud, which sends first: the schedules of the link begin shortly before the flight.
        self._start_links(robot, up_ns := time.monotonic_ns())
        if self._remote:
            self._start(robot.folder, CONTROLLER, "policy", "drive", socket=robot.sockets)
            self._wait_until_ready()
        cloud = partial(self._start_end, robot, "cloud", ROUTE_FILE, teleop=robot.sockets)
        cloud()
        self._wait_until_ready()
        again = {"cloud": cloud, "teleop": partial(self._start_teleop, robot)}
        self._faults.begin(up_ns * 1e-9, again)
        if session:
            session(robot.url, self._metrics)
        self._watch(limit, robot.sockets)

    def _open(
        self, folder: Path, at: Mapping[str, str], files: contextlib.ExitStack
    ) -> RobotProcesses:
        """Make the files of a robot's processes; `files` removes those that only a flight needs."""
        files.callback((folder / API_FILE).unlink, missing_ok=True)
        files.callback(shutil.rmtree, folder / LINK_FOLDER, ignore_errors=True)
        # The sockets are not in the run's folder, whose path may be too long for a Unix socket.
        # Their folder is private: it also contains this run's key.
        private = tempfile.TemporaryDirectory(prefix="cloudrc-", dir=socket_folder())
        robot = RobotProcesses(folder, Path(files.enter_context(private)), at)
        kind = SESSION if self._session else RUN
        self.announcement.enter_context(announced(folder, robot.url, kind))
        key = robot.sockets / "key"
        key.touch(0o600)
        key.write_text(write(KeySet(Key(os.urandom(KEY_SIZE)))), encoding="ascii")
        return robot

    def _start_end(self, robot: RobotProcesses, name: str, route: str, **more: object) -> None:
        """Start world or cloud; the file `route` will have the address to which it sends."""
        way = "uplink" if name == "world" else "downlink"
        self._start(
            robot.folder,
            name,
            "process",
            name,
            *(["--record-flights"] if self._session else []),
            listen=robot.at[name],
            route=robot.folder / LINK_FOLDER / way / route,
            key=robot.sockets / "key",
            record=robot.folder / f"{name}.mcap",
            **more,
        )

    def _start_teleop(self, robot: RobotProcesses) -> None:
        folder = robot.folder
        words = [f"--journal={folder / JOURNAL_FILE}"] if self._session else ["--start"]
        if self._faults.kills_teleop and not self._session:
            words += [f"--journal={robot.sockets / JOURNAL_FILE}"]
        # Only this user can open the socket of the API: no token is needed.
        self._start(
            folder,
            "teleop",
            "process",
            "teleop",
            *words,
            f"--api-file={folder / API_FILE}",
            socket=robot.sockets,
            api=robot.url,
            link=folder / LINK_FOLDER / "downlink" / STATE_FILE,
        )

    def _start_links(self, robot: RobotProcesses, origin_ns: int) -> None:
        """Start both directions of a robot's link; their schedules begin at `origin_ns` [ns]."""
        for way, end, peer in (("uplink", "world", "cloud"), ("downlink", "cloud", "world")):
            self._start(
                robot.folder,
                way,
                *link_words(robot.folder / LINK_FOLDER, way),
                mode="relay",
                origin=origin_ns,
                control=link_socket(robot.url, way),
                listen=robot.at[way],
                end=robot.at[end],
                peer=robot.at[peer],
            )

    def _start(self, folder: Path, name: str, *words: str, **options: object) -> None:
        options["config"] = folder / "config.yaml"
        if name in self._metrics:
            options["metrics"] = self._metrics[name]
        log = folder / f"{name}.log"
        with log.open("ab") as errors:
            process = start_process([*words, "--feed"], options, subprocess.PIPE, errors)
        assert process.stdout is not None
        os.set_blocking(process.stdout.fileno(), False)
        label = str((folder / name).relative_to(self._folder))
        self._children.append(Child(label, process, log, heard=self._clock()))
        self._selector.register(process.stdout, selectors.EVENT_READ, self._children[-1])

    def _wait_until_ready(self) -> None:
        until = self._clock() + START_LIMIT
        while waiting := [child.name for child in self._children if not child.ready]:
            if self._clock() > until:
                raise TimedOutError(f"{' and '.join(waiting)}: not ready within {START_LIMIT:g} s")
            self._see(self._listen())
            self._check_alive()

    def _watch(self, limit: float, sockets: Path) -> None:
        until, paused = self._clock() + limit, self._clock.pause
        while "teleop" in self._faults.away or any(
            child.is_teleop and child.process.poll() is None for child in self._children
        ):
            self._faults.act(time.monotonic(), self._children)
            records = self._listen()
            self._see(records)
            self._lost(records)
            if self._remote and self._gone():
                from cloudrc.flight.pod.transports.remote import tell_ended  # needs an extra

                tell_ended(sockets)
            now = self._clock()
            if now > until:
                raise TimedOutError(f"the flight was ended after {limit:g} s, its limit")
            if self._clock.pause > paused:
                stood = f"stood still for {self._clock.pause - paused:.1f} s; the flight went on"
                self.notes += (f"the supervisor of this run {stood}",)
                self._see([Fault(0, "supervisor", self.notes[-1])])
                paused = self._clock.pause
            self._check_alive()
            for child in self._children:
                if child.name in self._faults.away or not child.ready:
                    child.heard = now
                if now - child.heard > SILENCE_LIMIT and child.process.poll() is None:
                    raise TimedOutError(
                        f"the {child.name} process was silent for {SILENCE_LIMIT:g} s and was "
                        f"ended; see {child.log}"
                    )
        self._check_alive()
        self._see(self._listen())

    def _listen(self) -> list[Record]:
        records: list[Record] = []
        ready, now = self._selector.select(0.05), self._clock()
        for key, _ in ready:
            data = os.read(key.fd, 65_536)
            if not data:
                self._selector.unregister(key.fileobj)
            records += key.data.take(data, now)
        return records

    def _check_alive(self) -> None:
        for child in self._children:
            code = child.process.poll()
            is_over = child.is_teleop and code == 0 and not self._session
            if code is None or is_over:
                continue
            how = f"signal {-code}" if code < 0 else f"exit code {code}"
            said = child.log.read_text(errors="replace").strip() or "it left no message"
            if child.name == CONTROLLER and code == ControllerLostError.exit_code:
                text = said.splitlines()[-1].removeprefix("cloudrc: error: ")
                raise ControllerLostError(CONTROLLER_LOST[0], text)
            raise InvalidRunError(
                f"the {child.name} process died in flight ({how}): {said.splitlines()[-1]}; "
                f"see {child.log}"
            )

    def _stop(self) -> None:
        for child in self._children:
            child.process.terminate()
            child.process.send_signal(signal.SIGCONT)  # a fault may have stopped it
        deadline = time.monotonic() + STOP_LIMIT
        for child in self._children:
            await_or_kill(child.process, max(0.0, deadline - time.monotonic()))
            child.process.communicate()
        self._selector.close()
