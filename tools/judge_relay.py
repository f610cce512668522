"""Compare `cloudrc relay tcp` with `cloudrc link exec`: how long turns take, on the same link.

    python -m tools.judge_relay [--turns 40] [--control cubic]

A turn sends a number of bytes, and gets eight back: on a new connection (cold) or on a used one
(warm). The table has median and 95 % quantile [ms] of both. Needs what `link exec` needs.
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

SIZES = (200, 300_000, 1_400_000)  # bytes of a request
LINKS = {
    "ideal": "ideal",
    "lte": "lte",
    "1 % loss": "uplink: {delay_ms: 40, loss: 0.01}\ndownlink: {delay_ms: 40, loss: 0.01}\n",
}
FLOOR = 1.0  # difference of median or quantile that counts as none [ms]
MEDIAN, P95 = 0.10, 0.25  # accepted relative differences
WARM_UP, WARM = 4, 10  # turns of a connection that are not measured, and that are
PYTHON = sys.executable


def connect(where: tuple[str, int], control: str) -> socket.socket:
    """Connect with a congestion control; "" for that of the machine."""
    one = socket.socket()
    tune(one, control)
    one.connect(where)
    return one


def tune(one: socket.socket, control: str) -> None:
    """Set the options of a socket of both programs."""
    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    if control:
        one.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, control.encode())


def serve(port: int, control: str) -> None:
    """Answer each request, which begins with its length, by eight bytes."""

    def answer(one: socket.socket) -> None:
        tune(one, control)
        with one, contextlib.suppress(OSError):  # the client resets
            while len(head := one.recv(4, socket.MSG_WAITALL)) == 4:
                left = int.from_bytes(head, "big")
                while left:
                    left -= len(one.recv(min(left, 1 << 18)))
                one.sendall(bytes(8))

    listening = socket.create_server(("0.0.0.0", port), backlog=64)
    while True:
        one, _ = listening.accept()
        threading.Thread(target=answer, args=(one,), daemon=True).start()


def ask(where: tuple[str, int], turns: int, control: str) -> None:
    """Print size, kind, median and 95 % quantile of the time of turns [ms]."""
    for size in SIZES:
        request = size.to_bytes(4, "big") + bytes(size)

        def turn(one: socket.socket, request: bytes = request) -> None:
            one.sendall(request)
            if len(one.recv(8, socket.MSG_WAITALL)) != 8:
                raise ConnectionError("the server has closed the connection")

        cold = []
        for _ in range(turns):
            began = time.perf_counter()
            with connect(where, control) as one:
                turn(one)
                cold.append((time.perf_counter() - began) * 1e3)
        warm: list[float] = []
        while len(warm) < turns:
            with connect(where, control) as one:
                for number in range(WARM_UP + WARM):
                    began = time.perf_counter()
                    turn(one)
                    if number >= WARM_UP:
                        warm.append((time.perf_counter() - began) * 1e3)
        for kind, times in (("cold", cold), ("warm", warm)):
            times.sort()
            print(size, kind, times[len(times) // 2], times[int(0.95 * len(times))], flush=True)


def words(*given: object) -> list[str]:
    """Return the command line of this module with other arguments."""
    return [PYTHON, "-m", "tools.judge_relay", *map(str, given)]


def through_exec(link: str, options: argparse.Namespace) -> str:
    """Measure over `link exec`; return what `ask` prints."""
    client = " ".join(words("--control", f"'{options.control}'", "--turns", options.turns))
    command = [PYTHON, "-m", "cloudrc", "link", "exec", "--link", link]
    command += ["--server", " ".join(words("--control", f"'{options.control}'", "--serve", 9000))]
    command += ["--client", f"{client} --ask {{server}}:9000"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return done.stdout.replace("[client] ", "")


def through_relay(link: str, options: argparse.Namespace) -> str:
    """Measure over `relay tcp`; return what `ask` prints."""
    from cloudrc.drivers.realtime import free_ports

    inside, outside = free_ports(2)
    shared = ("--control", options.control)
    server = subprocess.Popen(words(*shared, "--serve", inside))
    command = [PYTHON, "-m", "cloudrc", "relay", "tcp", "--link", link]
    command += ["--listen", f"127.0.0.1:{outside}", "--to", f"127.0.0.1:{inside}"]
    relay = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL)
    try:
        assert relay.stderr is not None
        relay.stderr.readline()
        asking = words(*shared, "--turns", options.turns, "--ask", f"127.0.0.1:{outside}")
        return subprocess.run(asking, capture_output=True, text=True, check=True).stdout
    finally:
        relay.send_signal(signal.SIGINT)
        relay.wait()
        server.kill()
        server.wait()


def judge(options: argparse.Namespace) -> int:
    """Print the table; return 1 if a difference is too large."""
    off = 0
    print(f"{'link':10}{'bytes':>9} {'':6}{'exec p50':>10}{'relay':>10}{'p95':>10}{'relay':>10}")
    with tempfile.TemporaryDirectory() as folder:
        for name, link in LINKS.items():
            if ":" in link:
                path = Path(folder, "link.yaml")
                path.write_text(link, encoding="utf-8")
                link = str(path)
            both = [through(link, options).split() for through in (through_exec, through_relay)]
            for at in range(0, len(both[0]), 4):
                size, kind, *truth = both[0][at : at + 4]
                pairs = list(
                    zip(map(float, truth), map(float, both[1][at + 2 : at + 4]), strict=True)
                )
                near = [
                    abs(other - true) <= max(FLOOR, share * true)
                    for (true, other), share in zip(pairs, (MEDIAN, P95), strict=True)
                ]
                off += near.count(False)
                cells = "".join(f"{value:10.1f}" for pair in pairs for value in pair)
                print(f"{name:10}{size:>9} {kind:6}{cells}  {'' if all(near) else 'differs'}")
    return 1 if off else 0


def main() -> int:
    """Judge, or be one of the two programs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--turns", type=int, default=40)
    parser.add_argument("--control", default="", help="congestion control (default: the machine's)")
    parser.add_argument("--serve", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--ask", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve, options.control)
    if options.ask:
        host, _, port = options.ask.rpartition(":")
        ask((host, int(port)), options.turns, options.control)
        return 0
    return judge(options)


if __name__ == "__main__":
    sys.exit(main())
