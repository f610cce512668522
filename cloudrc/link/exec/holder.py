# SPDX-License-Identifier: Apache-2.0

"""Hold one network namespace of `cloudrc link exec`, and run one program in it.

The command starts this module as a process, which enters a new namespace and sends the command a
file descriptor of the TUN device. Then it answers requests until the command closes the
connection or dies. At the end it ends every process in the namespace, and the namespace with it.
"""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from typing import Any

from cloudrc.base.errors import MissingPrerequisiteError
from cloudrc.link.exec import namespace
from cloudrc.link.exec.listening import dropped_packets, listening_at

REQUEST_MAX = 1 << 20  # longest request [bytes]
END_LIMIT = 1.5  # time for a program to end after SIGTERM; then it is killed [s]
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def main(descriptor: int, end: str) -> None:
    """Serve requests on the socket `descriptor`; `end` is "client" or "server"."""
    for number in SIGNALS:
        # A function, because a program that this process starts would inherit SIG_IGN.
        signal.signal(number, lambda *_: None)
    with socket.socket(fileno=descriptor) as command:
        command.set_inheritable(False)
        try:
            way = namespace.enter()
            device, has_ipv6 = namespace.open_device(namespace.ADDRESSES[end])
        except MissingPrerequisiteError as error:
            command.send(json.dumps({"missing": str(error)}).encode())
            return
        own = namespace.identity()
        try:
            _reply(command, {"way": way, "ipv6": has_ipv6, "namespace": own}, device)
            os.close(device)
            _serve(command)
        finally:
            end_all(own)


def _serve(command: socket.socket) -> None:
    """Answer requests until the command closes the connection."""
    program: subprocess.Popen[bytes] | None = None
    while request := command.recv(REQUEST_MAX):
        asked = json.loads(request)
        if words := asked.get("run"):
            program = subprocess.Popen(words)
            _reply(command, {"pid": program.pid})
        elif family := asked.get("socket"):
            with socket.socket(family, socket.SOCK_STREAM) as one:
                _reply(command, {}, one.fileno())
        else:
            _reply(command, _state(program))


def _state(program: subprocess.Popen[bytes] | None) -> dict[str, Any]:
    code = None if program is None else program.poll()
    # A program that went to the background has ended, but its child serves.
    lives = code is None or bool(namespace.inhabitants(namespace.identity()))
    dropped = dropped_packets(namespace.DEVICE)
    return {"code": code, "lives": lives, "listens": listening_at(), "dropped": dropped}


def _reply(command: socket.socket, answer: dict[str, Any], *descriptors: int) -> None:
    socket.send_fds(command, [json.dumps(answer).encode()], descriptors)


def end_all(own: str) -> None:
    """End all other processes in the network namespace `own`: first ask, then kill."""
    deadline = time.monotonic() + END_LIMIT
    namespace.kill(own, signal.SIGTERM)
    while namespace.inhabitants(own):
        if time.monotonic() > deadline:
            namespace.kill(own, signal.SIGKILL)
        time.sleep(0.02)
        _reap()


def _reap() -> None:
    """Collect the exit codes of programs that have ended; a zombie stays in its namespace."""
    try:
        while os.waitpid(-1, os.WNOHANG)[0]:
            pass
    except ChildProcessError:
        return


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2])
