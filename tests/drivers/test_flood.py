"""A flood on world's port loses no valid datagram and does not delay the guard."""

import random
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from statistics import median

import numpy as np
import pytest

from cloudrc.config.schema import Criteria, Mission
from cloudrc.faults.scenarios.intruder import REFUSED
from cloudrc.geometry.scene import load_scene
from cloudrc.metrics import Flight
from cloudrc.metrics.control import wakes
from cloudrc.metrics.link import SENT, SETTLING_NS, loss
from cloudrc.metrics.mission import holds
from cloudrc.record.columns import Recording
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Kind
from tests.drivers.conftest import start, wait_until_flying

pytestmark = [pytest.mark.process, pytest.mark.full]

RATE, SECONDS = 10_000, 20
PAIRS = 3
"""Pairs of a calm and a flooded flight; the median of their differences counts."""


def garbage(count, seed):
    """Make noise, valid headers with a wrong length, and valid lengths with a wrong tag."""
    rng, made = random.Random(seed), []
    for number in range(count):
        if number % 3 == 0:
            made.append(rng.randbytes(rng.choice((0, 1, 15, 16, 64, 300, 1400))))
            continue
        size = codec.BODY_SIZES[Kind.COMMAND] + codec.TAG_SIZE + number % 3 - 2
        header = struct.pack("<BBIxBQ", codec.VERSION, 1, rng.choice((1, 2)), Kind.COMMAND, number)
        made.append(header + rng.randbytes(size))
    return made


def flood(port):
    """Send RATE datagrams a second, in bursts of one millisecond; print their number."""
    made, sent, began = garbage(5000, 1), 0, time.monotonic()
    with socket.socket(type=socket.SOCK_DGRAM) as udp:
        while (passed := time.monotonic() - began) < SECONDS:
            while sent < passed * RATE:
                udp.sendto(made[sent % len(made)], ("127.0.0.1", port))
                sent += 1
            time.sleep(0.001)
    print(sent)


def fly(folder, *, flooded):
    """Hover for 25 s; return the flight, the number of hostile datagrams, and p99 [s].

    p99 is the 99th percentile of the time from each deadline to the end of its handling, during the
    flood or in the same window of a calm flight.
    """
    run = start(folder, "link.profile=ideal", dwell=23.0)
    world = wait_until_flying(run)["world"]
    sent, began_ns = 0, time.monotonic_ns()
    if flooded:
        words = Path(f"/proc/{world}/cmdline").read_text().split("\0")
        (port,) = (word.rpartition(":")[2] for word in words if word.startswith("--listen="))
        program = f"from tests.drivers.test_flood import flood; flood({port})"
        root = Path(__file__).parents[2]
        sent = int(subprocess.check_output([sys.executable, "-c", program], cwd=root))
    else:
        time.sleep(SECONDS)
    ended_ns = time.monotonic_ns()
    run.communicate(timeout=90)
    recording = Recording.read(folder / "mission.mcap")
    flight = Flight(recording, Criteria(), Mission(), load_scene("empty"))
    woken = wakes(flight, "world")
    meanwhile = (woken["stamp_ns"] >= began_ns) & (woken["stamp_ns"] < ended_ns)
    assert meanwhile.sum() >= 0.95 * 100 * SECONDS
    done = (woken["lateness"] + woken["busy"])[meanwhile]
    return flight, sent, float(np.percentile(done, 99.0))


def refused(flight):
    """Return the number of datagrams that world has rejected."""
    counts = flight.recording["/count"]
    rows = zip(counts["end"], counts["name"], counts["total"], strict=True)
    last = {name: int(total) for end, name, total in rows if end == "world"}
    return sum(last.get(name, 0) for name in REFUSED)


def check_flood(folder, figure):
    """Fly one pair; check the losses; return the growth of the 99th percentile [s]."""
    calm, _, calm_p99 = fly(folder / "calm", flooded=False)
    flight, sent, p99 = fly(folder / "stormy", flooded=True)
    settled_ns = flight.recording["/telemetry"]["stamp_ns"][-1] - SETTLING_NS
    stamps = [flight.during(topic)["stamp_ns"] for topic in SENT.values()]
    honest = sum(int((one <= settled_ns).sum()) for one in stamps)
    kind, counted = f"garbage flood, {folder.name}", refused(flight) / sent
    figure(f"{kind}: sent to the real port", sent, ">=", 0.98 * RATE * SECONDS)
    figure(f"{kind}: counted as refused, share", counted, ">=", 0.98, count=sent)
    losses = [loss(flight, way) for way in SENT]
    figure(f"{kind}: honest datagrams lost, share", max(losses), "==", 0.0, count=honest)
    assert honest >= 0.95 * 2 * 100 * SECONDS
    assert len(holds(flight)) == len(holds(calm))
    return p99 - calm_p99


def test_ten_thousand_a_second_for_twenty_seconds(tmp_path, figure):
    grown = median(check_flood(tmp_path / f"pair {n + 1}", figure) for n in range(PAIRS))
    name = f"garbage flood, median of {PAIRS} pairs: guard tick done, p99 grows by"
    figure(name, grown * 1e3, "<=", 1.0, "ms", count=PAIRS)
