# SPDX-License-Identifier: Apache-2.0

"""Run programs in network namespaces, and forward ports of this machine into one of them.

Each namespace belongs to a holder process (`cloudrc/link/exec/holder.py`), which ends every
process in its namespace when this process closes the connection or dies.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import socketserver
import subprocess
import threading
from contextlib import ExitStack, suppress
from functools import partial
from typing import IO, Any, NamedTuple

from cloudrc.base.errors import InvalidRunError, MissingPrerequisiteError
from cloudrc.base.files import at_place
from cloudrc.flight.machine import await_or_kill, interpreter
from cloudrc.flight.pod.servers import ThreadedServer
from cloudrc.link.exec import namespace
from cloudrc.link.exec.holder import END_LIMIT

ANSWER_MAX = 1 << 20
"""Largest size of an answer of a holder [bytes]."""
LINE_MAX = 1 << 16
"""Length at which a line without an end is printed [bytes]."""
SIGNALLED = 128
"""Exit code of a program that a signal has ended, less the number of the signal."""
CHUNK = 1 << 16
"""Most data that a forwarded connection reads at a time [bytes]."""


class ProgramState(NamedTuple):
    """ProgramState of a namespace and its program."""

    code: int | None  # exit code of the program; None while it runs
    lives: bool  # whether the program or a process that it started runs
    listens: list[tuple[str, int]]  # host and port of each socket that listens
    dropped: int  # packets that the device dropped, because the relay did not read in time


class ProgramEnd:
    """One end of the link: a network namespace with a TUN device, and the program in it.

    Attributes:
        way: Privilege that allowed the namespace: "root" or "unprivileged user namespaces".
        has_ipv6: Whether the namespace has IPv6.
        device: File descriptor of the TUN device, which reads and writes packets.
    """

    def __init__(self, name: str, *, reads_stdin: bool = False) -> None:
        """Make the namespace of the end `name`, "client" or "server".

        With `reads_stdin`, the program reads this process's standard input.

        Raises:
            MissingPrerequisiteError: If this machine forbids it; the text says what to allow.
        """
        self.name, self._lock = name, threading.Lock()
        self._connection, far = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        words = interpreter("-m", "cloudrc.link.exec.holder", str(far.fileno()), name)
        with far:
            self._process = subprocess.Popen(
                words,
                stdin=None if reads_stdin else subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                pass_fds=[far.fileno()],
                # A program that writes to a pipe would hold its lines back.
                env={**os.environ, "PYTHONUNBUFFERED": "1"},
            )
        self.device, self._namespace = -1, ""
        with ExitStack() as stack:
            stack.callback(self.close)
            hello, (self.device,) = self._read_answer(1)
            stack.pop_all()
        self.way, self.has_ipv6 = hello["way"], hello["ipv6"]
        self._namespace = hello["namespace"]

    @property
    def outputs(self) -> tuple[IO[bytes], IO[bytes]]:
        """Standard output and standard error of the program."""
        process = self._process
        assert process.stdout is not None
        assert process.stderr is not None
        return process.stdout, process.stderr

    def run(self, command: str) -> None:
        """Start a program by a command of the shell."""
        self._ask(run=["/bin/sh", "-c", command])

    def state(self) -> ProgramState:
        """Return the state of the program and its namespace."""
        answer, _ = self._ask()
        listens = [(host, port) for host, port in answer["listens"]]
        code = answer["code"]
        if code is not None and code < 0:  # as the shell tells a signal
            code = SIGNALLED - code
        return ProgramState(code, answer["lives"], listens, answer["dropped"])

    def connect(self, host: str, port: int) -> socket.socket:
        """Connect to an address from inside of the namespace; raise an OSError if it fails."""
        _, (descriptor,) = self._ask(1, socket=socket.AF_INET)
        inside = socket.socket(fileno=descriptor)
        try:
            inside.connect((host, port))
        except OSError:
            inside.close()
            raise
        return inside

    def hang_up(self) -> None:
        """Let the holder end all processes in the namespace; do not wait."""
        self._connection.close()
        if self._process.poll() is not None and self._namespace:  # somebody killed the holder
            namespace.kill(self._namespace, signal.SIGKILL)

    def close(self) -> None:
        """ProgramEnd all processes in the namespace, and the namespace with them."""
        self.hang_up()
        await_or_kill(self._process, END_LIMIT + 1.0)
        self.hang_up()
        if self.device >= 0:
            os.close(self.device)
        for output in self.outputs:
            output.close()

    def _ask(self, descriptors: int = 0, **request: Any) -> tuple[dict[str, Any], list[int]]:
        with self._lock:
            try:
                self._connection.send(json.dumps(request).encode())
                return self._read_answer(descriptors)
            except OSError:
                raise self._lost() from None

    def _read_answer(self, descriptors: int) -> tuple[dict[str, Any], list[int]]:
        """Read an answer that comes with a number of file descriptors."""
        data, found, _, _ = socket.recv_fds(self._connection, ANSWER_MAX, descriptors)
        if not data:
            raise self._lost()
        answer = json.loads(data)
        if text := answer.get("missing"):
            raise MissingPrerequisiteError(text)
        return answer, found

    def _lost(self) -> InvalidRunError:
        return InvalidRunError(
            f"the process that holds the {self.name}'s namespace has died; start the command again"
        )


def print_lines(source: IO[bytes], target: IO[bytes], prefix: str) -> threading.Thread:
    """Start a thread that copies lines from `source` to `target`, each behind a prefix."""

    def work() -> None:
        for line in iter(partial(source.readline, LINE_MAX), b""):
            with suppress(OSError, ValueError):  # nobody reads any more
                target.write(mark + line.removesuffix(b"\n") + b"\n")
                target.flush()

    mark = prefix.encode()
    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    return thread


class _Forwarded(socketserver.BaseRequestHandler):
    server: Forwarder

    def handle(self) -> None:
        with self.server.connect() as inside:
            back = threading.Thread(target=_pump, args=(inside, self.request), daemon=True)
            back.start()
            _pump(self.request, inside)
            back.join()


class Forwarder(ThreadedServer, socketserver.TCPServer):
    """Forwards connections to a port of this machine to the same port in a namespace."""

    def __init__(self, end: ProgramEnd, port: int) -> None:
        """Listen at `port` on 127.0.0.1, on threads of its own."""
        self._end, self._port = end, port
        with at_place(f"--expose {port}"):
            super().__init__(("127.0.0.1", port), _Forwarded)
        self.start()

    def connect(self) -> socket.socket:
        """Connect to the program: at the address of the link, else at its own loopback address."""
        try:
            return self._end.connect(namespace.ADDRESSES[self._end.name].ipv4, self._port)
        except OSError:
            return self._end.connect("127.0.0.1", self._port)


def _pump(source: socket.socket, target: socket.socket) -> None:
    """Copy a stream of bytes until its end, and hand on the end."""
    try:
        while data := source.recv(CHUNK):
            target.sendall(data)
        target.shutdown(socket.SHUT_WR)
    except OSError:  # the other side is closed
        return
