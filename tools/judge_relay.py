"""Compare `cloudrc relay tcp` with `cloudrc link exec`: how long turns take, on the same link.

    python -m tools.judge_relay [--rounds 6]

A turn sends a number of bytes, and gets eight back: on a new connection (cold) or on a used one
(warm). A round measures both at the same time, because other load on the machine changes; each
round has a seed of its own. The table has median and 95 % quantile [ms] of both. Over the link with
loss, 16 connections measure at once, because their times differ much; it has no rate, so that they
do not meet. Needs root, and what `link exec` needs.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from statistics import quantiles

from cloudrc.drivers.realtime import free_ports

TURNS = {200: 30, 300_000: 15, 1_400_000: 5}
"""Bytes of a request -> turns of a round."""
LINKS = {
    "ideal": "ideal",
    "lte": "lte",
    "loss": "uplink: {delay_ms: 40, loss: 0.01}\ndownlink: {delay_ms: 40, loss: 0.01}\n",
}
CROWDS = {"loss": 16}  # connections at once, if not one
WARM_UP, WARM = 4, 5  # turns of a connection that are not measured, and that are
PYTHON = sys.executable

Times = dict[tuple[int, str], list[float]]
"""Bytes and "cold" or "warm" -> times of turns [ms]."""


def tune(one: socket.socket) -> None:
    """Set the options of a socket of both programs."""
    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    one.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, b"cubic")


def serve(port: int) -> None:
    """Answer each request, which begins with its length, by eight bytes."""

    def answer(one: socket.socket) -> None:
        tune(one)
        with one, contextlib.suppress(OSError):  # the client resets
            while len(head := one.recv(4, socket.MSG_WAITALL)) == 4:
                left = int.from_bytes(head, "big")
                while left:
                    left -= len(one.recv(min(left, 1 << 18)))
                one.sendall(bytes(8))

    listening = socket.create_server(("0.0.0.0", port), backlog=64)
    print("listening", flush=True)
    while True:
        one, _ = listening.accept()
        threading.Thread(target=answer, args=(one,), daemon=True).start()


def ask(where: tuple[str, int]) -> None:
    """Print bytes, kind and time [ms] of the turns of a round."""
    for size, turns in TURNS.items():
        for _ in range(turns):
            tell(size, "cold", next(on_one_connection(where, size)))
        for _ in range(max(1, turns // WARM)):
            times = list(on_one_connection(where, size))
            for taken in times[WARM_UP:]:
                tell(size, "warm", taken)


def tell(size: int, kind: str, taken: float) -> None:
    """Print a turn in one piece, because several threads print."""
    sys.stdout.write(f"{size} {kind} {taken}\n")


def on_one_connection(where: tuple[str, int], size: int) -> Iterator[float]:
    """Connect, and yield how long turns take; the first one includes the connection."""
    request = size.to_bytes(4, "big") + bytes(size)
    began = time.perf_counter()
    with socket.socket() as one:
        tune(one)
        one.connect(where)
        for _ in range(WARM_UP + WARM):
            one.sendall(request)
            if len(one.recv(8, socket.MSG_WAITALL)) != 8:
                raise ConnectionError("the server has closed the connection")
            yield (time.perf_counter() - began) * 1e3
            began = time.perf_counter()


def words(*given: object) -> list[str]:
    """Return the command line of this module with other arguments."""
    return [PYTHON, "-m", "tools.judge_relay", *map(str, given)]


def through_exec(link: str, seed: int, crowd: int) -> str:
    """Measure over `link exec`; return what `ask` prints."""
    command = [PYTHON, "-m", "cloudrc", "link", "exec", "--link", link, "--seed", str(seed)]
    command += ["--server", " ".join(words("--serve", 9000))]
    asking = words("--ask", "{server}:9000", "--crowd", crowd)
    command += ["--client", " ".join(asking)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    lines = done.stdout.splitlines()
    return "\n".join(line.removeprefix("[client] ") for line in lines if "[client]" in line)


def through_relay(link: str, seed: int, crowd: int) -> str:
    """Measure over `relay tcp`; return what `ask` prints."""
    port, entry = free_ports(2)
    command = [PYTHON, "-m", "cloudrc", "relay", "tcp", "--link", link, "--seed", str(seed)]
    command += ["--listen", f"127.0.0.1:{entry}", "--to", f"127.0.0.1:{port}"]
    with (
        subprocess.Popen(words("--serve", port), stdout=subprocess.PIPE) as server,
        subprocess.Popen(command, stderr=subprocess.PIPE) as relay,
    ):
        assert server.stdout is not None
        assert relay.stderr is not None
        server.stdout.readline()  # they listen
        relay.stderr.readline()
        asking = words("--ask", f"127.0.0.1:{entry}", "--crowd", crowd)
        done = subprocess.run(asking, capture_output=True, text=True, check=True)
        relay.kill()
        server.kill()
    return done.stdout


WAYS = {"exec": through_exec, "relay": through_relay}


def measure(way: str, link: str, seed: int, crowd: int, times: Times) -> None:
    """Measure a round, and add it to `times`."""
    for line in WAYS[way](link, seed, crowd).splitlines():
        size, kind, taken = line.split()
        times[int(size), kind].append(float(taken))


def compare(rounds: int) -> None:
    """Print a row of the table for each link, number of bytes, and kind of connection."""
    print(f"{'link':6}{'bytes':>9} {'':5}{'turns':>6}", end="")
    print(f"{'exec p50':>10}{'relay':>9}{'exec p95':>10}{'relay':>9}")
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(len(WAYS)) as pool:
        for name, text in LINKS.items():
            (path := Path(folder, "link.yaml")).write_text(text, encoding="utf-8")
            link = str(path) if ":" in text else text
            found: dict[str, Times] = {way: defaultdict(list) for way in WAYS}
            for seed in range(1, rounds + 1):
                crowd = CROWDS.get(name, 1)
                doing = [pool.submit(measure, way, link, seed, crowd, found[way]) for way in WAYS]
                for one in doing:
                    one.result()
            for (size, kind), exact in found["exec"].items():
                row = f"{name:6}{size:>9} {kind:5}{len(exact):>6}"
                for percent in (50, 95):
                    row += f"{quantile(exact, percent):>10.1f}"
                    row += f"{quantile(found['relay'][size, kind], percent):>9.1f}"
                print(row, flush=True)


def quantile(times: Sequence[float], percent: int) -> float:
    """Return a quantile of times [ms]."""
    return quantiles(times, n=100, method="inclusive")[percent - 1]


def main() -> int:
    """Compare, or be one of the two programs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=6, help="rounds of each (default: 6)")
    parser.add_argument("--serve", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--ask", help=argparse.SUPPRESS)
    parser.add_argument("--crowd", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.serve:
        serve(options.serve)
    if options.ask:
        host, _, port = options.ask.rpartition(":")
        with ThreadPoolExecutor(options.crowd) as pool:
            doing = [pool.submit(ask, (host, int(port))) for _ in range(options.crowd)]
            for one in doing:
                one.result()
        return 0
    # Other programs of this machine would delay the packets of `link exec`, each one a little.
    os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))
    compare(options.rounds)
    return 0


if __name__ == "__main__":
    sys.exit(main())
