"""A flood of garbage on world's real port: no honest datagram is lost, the guard's ticks keep."""

from __future__ import annotations

import json
import random
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Kind

pytestmark = [pytest.mark.process, pytest.mark.full]

RATE, SECONDS = 10_000, 20
FLOODER = """
import sys
sys.path[:0] = {path!r}
from test_flood import flood
flood(("127.0.0.1", {port}), {rate}, {seconds})
"""


def garbage(count: int, seed: int) -> list[bytes]:
    """A third noise, a third with our header but not our length, a third that needs its tag."""
    rng, made = random.Random(seed), []
    for number in range(count):
        if number % 3 == 0:
            made.append(rng.randbytes(rng.choice((0, 1, 15, 16, 64, 300, 1400))))
            continue
        size = codec.BODY_SIZES[Kind.COMMAND] + codec.TAG_SIZE + number % 3 - 2
        epoch, generation = rng.choice((1, 2)), rng.choice((0, 0, 1, 7, 130))
        header = struct.pack("<BBIBBQ", codec.VERSION, 1, epoch, generation, Kind.COMMAND, number)
        made.append(header + rng.randbytes(size))
    return made


def flood(target: tuple[str, int], rate: int, seconds: float) -> None:
    """Send `rate` a second, in bursts of one millisecond."""
    made, sent, start = garbage(5000, 1), 0, time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        while (passed := time.monotonic() - start) < seconds:
            while sent < passed * rate:
                udp.sendto(made[sent % len(made)], target)
                sent += 1
            time.sleep(0.001)
    print(sent)


def fly(folder: Path, *, flooded: bool) -> tuple[dict[str, float], int]:
    """Hover for 25 s over an ideal link; the report's numbers, and how much garbage was sent."""
    command = [sys.executable, "-m", "cloudrc", "run", "hover", "--mode", "local"]
    for setting in ("mission.waypoints.0.dwell_s=23", "link.profile=ideal"):
        command += ["--set", setting]
    run = subprocess.Popen([*command, "--out", str(folder)], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    for line in run.stdout:
        if "mission started" in line:
            break
    sent = 0
    if flooded:
        here = [str(Path(__file__).parent), str(Path(__file__).parents[2])]
        program = FLOODER.format(path=here, port=port_of_world(run.pid), rate=RATE, seconds=SECONDS)
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
        sent = int(done.stdout)
    run.communicate(timeout=90)
    numbers = json.loads((folder / "report.json").read_text())["numbers"]
    return {name: number["value"] for name, number in numbers.items()}, sent


def port_of_world(parent: int) -> int:
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_text().split("\0")
            stat = (path.parent / "stat").read_text()
        except OSError:
            continue
        if "world" in words and int(stat.rpartition(")")[2].split()[1]) == parent:
            listen = next(word for word in words if word.startswith("--listen="))
            return int(listen.rpartition(":")[2])
    raise AssertionError("no world")


def test_ten_thousand_a_second_for_twenty_seconds(
    tmp_path: Path, figure: Callable[..., None]
) -> None:
    calm, _ = fly(tmp_path / "calm", flooded=False)
    stormy, sent = fly(tmp_path / "stormy", flooded=True)
    grown = stormy["world_lateness_p99"] - calm["world_lateness_p99"]
    lost = max(stormy["loss_downlink"], stormy["loss_uplink"])
    figure("garbage flood on the real port: sent", sent, ">=", 0.98 * RATE * SECONDS)
    figure("garbage flood: honest datagrams lost, share", lost, "==", 0.0)
    figure("garbage flood: guard tick p99 grows by", grown * 1e3, "<=", 1.0, "ms")
    assert sent >= 0.98 * RATE * SECONDS
    assert stormy["loss_downlink"] == stormy["loss_uplink"] == 0.0
    assert stormy["hold_count"] == calm["hold_count"]
    assert grown <= 0.001
