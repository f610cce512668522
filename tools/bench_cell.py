# SPDX-License-Identifier: Apache-2.0

"""`make bench-cell`: how punctual is the process `cloudrc process cell` with many robots?

Each robot's world and cloud send 100 datagrams a second through one process. Beside it,
`tools/wake_lateness.c` measures how late this machine wakes a sleeping process in the same time.
Close other programs first. Exit codes: 0 all limits were kept, 1 a limit was exceeded, 3 there is
no C compiler.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from multiprocessing import Process
from pathlib import Path
from random import Random

from cloudrc.base.text import table
from cloudrc.flight.machine import interpreter
from cloudrc.flight.pod.realtime import free_ports
from cloudrc.wire.tunnel.codec import SIZES, Kind, encode_header, peek

EXPERIMENT = """\
world: {{scene: empty}}
mission: steps
fleet: {{robots: {robots}}}
cell: {{rate_kbit: {rate}, queue_packets: 10000}}  # no drops when the sender was late
link: {{profile: paper-p3}}
"""
KINDS = {"uplink": Kind.TELEMETRY, "downlink": Kind.COMMAND}
_SO_RCVBUFFORCE = 33  # Source: Linux, include/uapi/asm-generic/socket.h
SLOT, PERIOD = 0.001, 0.01
"""Time between two bursts of the sender, and between two datagrams of an end [s]."""


def send(ports: dict[str, int], robots: int, periods: int) -> None:
    """Send from each end a datagram in each period, at a random phase."""
    out, draws = socket.socket(socket.AF_INET, socket.SOCK_DGRAM), Random(1)
    slots = [list[tuple[str, int]]() for _ in range(round(PERIOD / SLOT))]
    for robot in range(robots):
        for way in ports:
            draws.choice(slots).append((way, robot))
    begin = time.monotonic() + 0.2
    for number in range(periods):
        for slot, ends in enumerate(slots):
            time.sleep(max(0.0, begin + number * PERIOD + slot * SLOT - time.monotonic()))
            for way, robot in ends:
                kind = KINDS[way]
                head = encode_header(kind, way == "downlink", robot + 1, number)
                out.sendto(head.ljust(SIZES[kind], b"\0"), ("127.0.0.1", ports[way] + robot))


def receive(one: socket.socket, expected: int, seconds: float) -> Counter[tuple[int, int]]:
    """Count the datagrams of each kind and robot."""
    found, until = Counter[tuple[int, int]](), time.monotonic() + seconds
    one.settimeout(0.2)
    while found.total() < expected and time.monotonic() < until:
        try:
            data = one.recv(2048)
        except TimeoutError:
            continue
        kind, epoch, _ = peek(data)
        found[kind, epoch - 1] += 1
    return found


def measure(
    robots: int, seconds: float, folder: Path
) -> tuple[dict[str, int], Counter[tuple[int, int]], list[float], float]:
    """Run the cell.

    Return its counts, what has arrived, p50 and p99 of waking [us], the cell's part of a core.
    """
    wake = folder / "wake_lateness"
    source = Path(__file__).with_name("wake_lateness.c")
    subprocess.run(["cc", "-O2", "-o", wake, source], check=True)
    config, log = folder / "fleet.yaml", folder / "cell.log"
    config.write_text(EXPERIMENT.format(robots=robots, rate=400 * robots))
    sink = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    with suppress(PermissionError):  # without it, a busy machine may drop what has arrived here
        sink.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, 1 << 26)
    sink.bind(("0.0.0.0", 0))
    to, (up, down) = f"127.1.{{robot}}.1:{sink.getsockname()[1]}", free_ports(2, robots)
    ways = f"--uplink 127.0.0.1:{up} --downlink 127.0.0.1:{down} --worlds {to} --clouds {to}"
    words = f"process cell --config {config} {ways} --record {folder / 'cell.csv'} --feed".split()
    with log.open("wb") as errors:
        cell = subprocess.Popen(
            interpreter("-m", "cloudrc", *words), stdout=subprocess.PIPE, stderr=errors
        )
    assert cell.stdout is not None
    cell.stdout.readline()  # it is ready
    waking = subprocess.Popen([wake, str(seconds)], stdout=subprocess.PIPE, text=True)
    periods = round(seconds / PERIOD)
    sender = Process(target=send, args=({"uplink": up, "downlink": down}, robots, periods))
    sender.start()
    arrived = receive(sink, 2 * robots * periods, seconds + 5)
    sender.join()
    stat = Path(f"/proc/{cell.pid}/stat").read_text().rpartition(")")[2].split()
    used = (int(stat[11]) + int(stat[12])) / os.sysconf("SC_CLK_TCK")
    cell.terminate()
    cell.communicate()
    sink.close()
    counts = json.loads(log.read_text().splitlines()[-1].removeprefix("cloudrc cell: "))
    return counts, arrived, [float(each) for each in waking.communicate()[0].split()], used


def main() -> int:
    """Measure, print the results and return the exit code."""
    parser = argparse.ArgumentParser(prog="make bench-cell", description=__doc__)
    parser.add_argument("--robots", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        try:
            found = measure(options.robots, options.seconds, Path(folder))
        except FileNotFoundError as error:
            print(f"bench-cell: {error.filename} is missing; install a C compiler", file=sys.stderr)
            return 3
    counts, arrived, (wake50, wake99), used = found
    sent = 2 * options.robots * round(options.seconds / PERIOD)
    lost, early = sent - arrived.total(), counts["released_early"]
    p50, p99 = (counts[f"release_error_{name}_ns"] * 1e-3 for name in ("p50", "p99"))
    system = f"Linux {platform.release()}, {os.cpu_count()} CPUs, load {os.getloadavg()[0]:.1f}"
    lines = [
        ("datagrams lost", "0", f"{lost} of {sent}", not lost),
        ("lateness p50", "<= 50 us", f"{p50:.1f} us", p50 <= 50),
        ("lateness p99", f"<= {2 * wake99:.0f} us", f"{p99:.0f} us", p99 <= 2 * wake99),
        ("left too early", "0", f"{early}", not early),
        ("waking, p50; p99 (tools/wake_lateness.c)", "", f"{wake50:.0f}; {wake99:.0f} us", True),
        ("processor time of the cell", "", f"{used:.1f} s", True),
    ]
    rows = [(*line[:3], "" if line[3] else "MISSED") for line in lines]
    print(table([(system, "asked", "measured", ""), *rows]))
    return 0 if all(line[3] for line in lines) else 1


if __name__ == "__main__":
    sys.exit(main())
