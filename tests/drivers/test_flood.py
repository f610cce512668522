"""Floods of requests and of garbage disturb neither the control loop nor the guard."""

import json
import subprocess
import sys
import time
from itertools import pairwise
from pathlib import Path
from statistics import median

import numpy as np
import pytest

from cloudrc.faults.scenarios.intruder import REFUSED
from cloudrc.record.columns import Recording
from tests.drivers.conftest import TOKEN, Release

pytestmark = pytest.mark.process

POINT = {"position_m": [0.5, 0.0, 0.7], "tolerance_m": 0.2, "dwell_s": 55.0, "time_limit_s": 60}
HOVER = {"start": "spawn", "waypoints": [POINT]}
TRIES = 3
"""Number of attempts, as the machine may be busy."""
PERIOD = 0.010
"""Period of both loops [s]."""


def fly(folder, kind, seconds, rate):
    """Fly a calm interval, then a flooded one; return what the flood says, and a function.

    That returns the columns of a topic of an end: before, during and after the flood.
    """
    folder.mkdir()
    release = Release(folder, "world", "cloud")
    target = {"requests": [release.url, TOKEN], "garbage": [release.flags["world"][1]]}[kind]
    script = str(Path(__file__).with_name("flood.py"))
    command = [sys.executable, script, kind, *target, str(seconds), str(rate)]
    try:
        release.post("/v1/missions", HOVER)
        release.until(lambda: release.mission()["state"] == "flying")
        time.sleep(2.0)
        edges = [time.monotonic_ns()]
        time.sleep(seconds)
        edges.append(time.monotonic_ns())
        environ = {"PYTHONPATH": str(Path(__file__).parents[2])}
        answers = json.loads(subprocess.check_output(command, env=environ))
        edges.append(time.monotonic_ns())
        time.sleep(1.5)  # until the counts are written
        assert release.mission()["state"] == "flying"
        release.post("/v1/estop")
        release.until_guard("ESTOP")
        release.stop()
        edges.append(time.monotonic_ns())
    finally:
        release.end()

    def columns(end, topic):
        table = Recording.read(folder / f"{end}.mcap")[topic]
        stamps = table["stamp_ns"]
        spans = [(stamps >= begin) & (stamps < end) for begin, end in pairwise(edges)]
        return [{name: table[name][span] for name in table.names} for span in spans]

    return answers, columns


@pytest.mark.promise("api-load-spares-the-loop")
@pytest.mark.parametrize(
    ("seconds", "tries"), [(3.0, TRIES), pytest.param(20.0, 1, marks=pytest.mark.full)]
)
def test_a_flood_of_requests_does_not_disturb_the_loop(tmp_path, figure, seconds, tries):
    asked = 1000
    for number in range(tries):
        answers, columns = fly(tmp_path / str(number), "requests", seconds, asked)
        took, sent = answers.pop("seconds"), answers.pop("sent")
        assert sum(answers.values()) == sent == seconds * asked
        assert not [status for status in answers if status.startswith("5")]
        periods = [np.diff(part["stamp_ns"]) * 1e-9 for part in columns("cloud", "/cmd_vel")[:2]]
        assert min(map(len, periods)) > 0.5 * seconds / PERIOD
        calm, loud = (np.percentile(np.abs(part - PERIOD), 99) * 1e3 for part in periods)
        rate, grown = sent / took, loud - calm
        if rate >= 0.9 * asked and grown <= 2.0:
            break
    kind = f"API flood of {seconds:g} s, best of {tries}"
    figure(f"{kind}: answers", rate, ">=", 0.9 * asked, "1/s", count=sent)
    figure(f"{kind}: control period error p99 grows by", grown, "<=", 2.0, "ms")


def lost(sent, received):
    """Count the datagrams that were sent during the flood and never arrived."""
    keys = [set(zip(part["epoch"], part["counter"], strict=True)) for part in (sent[1], *received)]
    return len(keys[0].difference(*keys[1:]))


@pytest.mark.full
def test_a_flood_of_garbage_loses_no_datagram_and_delays_no_guard(tmp_path, figure):
    grown, seconds, asked = [], 20.0, 10_000
    for number in range(TRIES):
        answers, columns = fly(tmp_path / str(number), "garbage", seconds, asked)
        kind = f"garbage flood, {number}"
        totals = {}
        for part in columns("world", "/count"):
            totals |= dict(zip(part["name"], part["total"].tolist(), strict=True))
        counted = sum(totals.get(name, 0) for name in REFUSED) / answers["sent"]
        figure(f"{kind}: sent to the real port", answers["sent"], ">=", 0.98 * asked * seconds)
        figure(f"{kind}: counted as refused, share", counted, ">=", 0.98, count=answers["sent"])
        up = lost(columns("world", "/telemetry"), columns("cloud", "/uplink_delay"))
        down = lost(columns("cloud", "/delay_estimate"), columns("world", "/downlink_delay"))
        figure(f"{kind}: honest datagrams lost", up + down, "==", 0)
        assert len(columns("world", "/guard")[1]["stamp_ns"]) == 0, "it never holds"
        woken = columns("world", "/lateness")[:2]
        assert min(len(part["busy"]) for part in woken) >= 0.95 * seconds / PERIOD
        calm, loud = (np.percentile(part["lateness"] + part["busy"], 99) for part in woken)
        grown.append((loud - calm) * 1e3)
    name = f"garbage flood, median of {TRIES}: guard tick done, p99 grows by"
    figure(name, median(grown), "<=", 1.0, "ms", count=TRIES)
