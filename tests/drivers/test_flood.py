"""A flood on world's port loses no valid datagram and does not delay the guard."""

import random
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from statistics import median
from typing import NamedTuple

import numpy as np
import pytest

from cloudrc.config.schema import Criteria
from cloudrc.faults.scenarios.intruder import REFUSED
from cloudrc.geometry.scene import load_scene
from cloudrc.metrics import Flight
from cloudrc.metrics.control import wakes
from cloudrc.metrics.link import SENT, SETTLING_NS, loss
from cloudrc.metrics.mission import hold_count
from cloudrc.record.columns import Recording
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Kind

pytestmark = [pytest.mark.process, pytest.mark.full]

RATE, SECONDS = 10_000, 20
PAIRS = 3
"""Pairs of a calm and a flooded flight; the median of their differences counts."""
FLOODER = """
import sys
sys.path[:0] = {path!r}
from tests.drivers.test_flood import flood
flood(("127.0.0.1", {port}), {rate}, {seconds})
"""


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


def flood(target, rate, seconds):
    """Send `rate` datagrams a second, in bursts of one millisecond."""
    made, sent, start = garbage(5000, 1), 0, time.monotonic()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        while (passed := time.monotonic() - start) < seconds:
            while sent < passed * rate:
                udp.sendto(made[sent % len(made)], target)
                sent += 1
            time.sleep(0.001)
    print(sent)


class Hover(NamedTuple):
    """A flight of 25 s over an ideal link.

    Attributes:
        flight: Its recording.
        began_ns: Start of the flood, or of the same window of a calm flight [ns], world's clock.
        ended_ns: End of that window [ns], world's clock.
        sent: Number of hostile datagrams.
    """

    flight: Flight
    began_ns: int
    ended_ns: int
    sent: int


def fly(folder, *, flooded):
    """Fly a hover, with or without a flood."""
    command = [sys.executable, "-m", "cloudrc", "run", "hover", "--mode", "local"]
    for setting in ("mission.waypoints.0.dwell_s=23", "link.profile=ideal"):
        command += ["--set", setting]
    run = subprocess.Popen([*command, "--out", str(folder)], stdout=subprocess.PIPE, text=True)
    assert run.stdout is not None
    for line in run.stdout:
        if "mission started" in line:
            break
    sent, began_ns = 0, time.monotonic_ns()
    if flooded:
        here = [str(Path(__file__).parents[2])]
        program = FLOODER.format(path=here, port=port_of_world(run.pid), rate=RATE, seconds=SECONDS)
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
        sent = int(done.stdout)
    else:
        time.sleep(SECONDS)
    ended_ns = time.monotonic_ns()
    run.communicate(timeout=90)
    recording = Recording.read(folder / "mission.mcap")
    return Hover(Flight(recording, Criteria(), 1, load_scene("empty")), began_ns, ended_ns, sent)


def port_of_world(parent):
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


def done_p99(hover):
    """Return the time from each deadline to the end of its handling [s]."""
    woken = wakes(hover.flight, "world")
    stamps = woken["stamp_ns"]
    meanwhile = (stamps >= hover.began_ns) & (stamps < hover.ended_ns)
    assert meanwhile.sum() >= 0.95 * 100 * SECONDS
    return float(np.percentile((woken["lateness"] + woken["busy"])[meanwhile], 99.0))


def refused(flight):
    """Return the number of datagrams that world has rejected."""
    counts = flight.recording["/count"]
    rows = zip(counts["end"], counts["name"], counts["total"], strict=True)
    last = {name: int(total) for end, name, total in rows if end == "world"}
    return sum(last.get(name, 0) for name in REFUSED)


def honest(flight):
    """Return the number of datagrams sent in both directions."""
    settled_ns = flight.recording["/telemetry"]["stamp_ns"][-1] - SETTLING_NS
    stamps = [flight.during(topic)["stamp_ns"] for topic in SENT.values()]
    return sum(int((one <= settled_ns).sum()) for one in stamps)


def check_flood(folder, figure):
    """Fly one pair; check the losses; return the growth of the 99th percentile [s]."""
    calm, stormy = fly(folder / "calm", flooded=False), fly(folder / "stormy", flooded=True)
    flight, sent = stormy.flight, stormy.sent
    counted = refused(flight) / sent
    losses, count = [loss(flight, way) for way in SENT], honest(flight)
    print(f"p99 {done_p99(calm) * 1e3:.2f} ms calm, {done_p99(stormy) * 1e3:.2f} ms flooded;"
          f" lost {losses} of {count}; refused {counted:.4f} of {sent}")  # fmt: skip
    kind = f"garbage flood, {folder.name}"
    figure(f"{kind}: sent to the real port", sent, ">=", 0.98 * RATE * SECONDS)
    figure(f"{kind}: counted as refused, share", counted, ">=", 0.98, count=sent)
    figure(f"{kind}: honest datagrams lost, share", max(losses), "==", 0.0, count=count)
    assert sent >= 0.98 * RATE * SECONDS
    assert counted >= 0.98, "not all of it has come to world's port"
    assert losses == [0.0, 0.0]
    assert count >= 0.95 * 2 * 100 * SECONDS
    assert hold_count(flight) == hold_count(calm.flight)
    return done_p99(stormy) - done_p99(calm)


def test_ten_thousand_a_second_for_twenty_seconds(tmp_path, figure):
    grown = median(check_flood(tmp_path / f"pair {n + 1}", figure) for n in range(PAIRS))
    name = f"garbage flood, median of {PAIRS} pairs: guard tick done, p99 grows by"
    figure(name, grown * 1e3, "<=", 1.0, "ms", count=PAIRS)
    assert grown <= 0.001
