"""A flood of requests to the API does not disturb the control loop in another process."""

import asyncio
import time
from collections import Counter
from itertools import pairwise

import numpy as np
import pytest

from cloudrc.record.columns import Recording
from tests.drivers.conftest import TOKEN, Release

POINT = {"position_m": [0.5, 0.0, 0.7], "tolerance_m": 0.2, "dwell_s": 55.0, "time_limit_s": 60}
HOVER = {"start": "spawn", "waypoints": [POINT]}
RATE = 1000
"""Requests in a second [1/s]."""
SECONDS = 3.0
"""Duration of a flood [s]."""
TRIES = 3
"""Number of attempts, of which the best counts: the machine may be busy."""
CONNECTIONS = 64
PERIOD = 0.010
"""Period of the control loop [s]."""


def request(method, path, token=""):
    lines = [f"{method} {path} HTTP/1.1", "Host: x", "Content-Length: 0"]
    if token:
        lines.append(f"Authorization: Bearer {token}")
    return ("\r\n".join(lines) + "\r\n\r\n").encode()


async def ask(address, requests, due, answers):
    """Send the requests one after the other, each when it is due [s], and read the answers."""
    reader, writer = await asyncio.open_connection(*address)
    for instant in due:
        await asyncio.sleep(instant - time.monotonic())
        answers["sent"] += 1
        writer.write(requests[answers["sent"] % len(requests)])
        head = await reader.readuntil(b"\r\n\r\n")
        await reader.readexactly(int(head.lower().partition(b"content-length: ")[2].split()[0]))
        answers[head[9:12].decode()] += 1
    writer.close()


async def ask_all(url, seconds):
    """Half of the requests read, a quarter has no token, a quarter is refused; count answers."""
    host, _, port = url.removeprefix("http://").partition(":")
    look, order = request("GET", "/v1/state", TOKEN), request("POST", "/v1/resume", TOKEN)
    mixed, answers = [look, request("GET", "/v1/state"), look, order], Counter()
    began = time.monotonic()
    due = [began + number / RATE for number in range(int(seconds * RATE))]
    each = (due[number::CONNECTIONS] for number in range(CONNECTIONS))
    await asyncio.gather(*(ask((host, int(port)), mixed, own, answers) for own in each))
    return answers | {"seconds": time.monotonic() - began}


def flood(folder, seconds):
    """Fly a calm and a flooded interval [s]; return the answers.

    Also the 99 % quantiles of the control period's error in both [ms].
    """
    folder.mkdir()
    release = Release(folder, "cloud")
    try:
        release.post("/v1/missions", HOVER)
        release.until(lambda: release.mission()["state"] == "flying")
        time.sleep(2.0)
        edges = [time.monotonic_ns()]
        time.sleep(seconds)
        edges.append(time.monotonic_ns())
        answers = asyncio.run(ask_all(release.url, seconds))
        edges.append(time.monotonic_ns())
        release.post("/v1/estop")
        release.until_guard("ESTOP")
        release.stop()
    finally:
        release.end()
    stamps = Recording.read(folder / "cloud.mcap")["/cmd_vel"]["stamp_ns"]
    periods = [np.diff(stamps[(stamps >= a) & (stamps < b)]) * 1e-9 for a, b in pairwise(edges)]
    assert min(map(len, periods)) > 0.5 * seconds / PERIOD
    return answers, [np.percentile(np.abs(each - PERIOD), 99) * 1e3 for each in periods]


@pytest.mark.process
@pytest.mark.promise("api-load-spares-the-loop")
def test_a_flood_of_requests_does_not_disturb_the_loop(tmp_path, figure):
    for number in range(TRIES):
        answers, (calm, loud) = flood(tmp_path / str(number), SECONDS)
        took, sent = answers.pop("seconds"), answers.pop("sent")
        assert sum(answers.values()) == sent == SECONDS * RATE
        assert not [status for status in answers if status.startswith("5")]
        rate, grown = sent / took, loud - calm
        if rate >= 0.9 * RATE and grown <= 2.0:
            break
    kind = f"API flood of {SECONDS:g} s, best of {TRIES}"
    figure(f"{kind}: answers", rate, ">=", 0.9 * RATE, "1/s", count=sent)
    figure(f"{kind}: control period error p99 grows by", grown, "<=", 2.0, "ms")
