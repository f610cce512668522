"""Faults with real scrapers of the metrics: such as hang, and such as ask without pause."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import time
from math import nan

import numpy as np

from cloudrc.faults.held import holds
from cloudrc.faults.real.kills import REAL, finish
from cloudrc.faults.real.processes import LOOPBACK, Processes
from cloudrc.faults.scenario import Outcome, Scenario

SLOW = 40
"""Clients of each process that never end their request."""
RATE, SECONDS = 200, 10
"""Scrapes of world a second, for so long [s]."""
SCRAPER = """
import json, socket, sys, threading, time
port, rate, seconds = map(int, sys.argv[1:])
took, pages, threads = [], set(), 4
def scrape():
    with socket.create_connection(("127.0.0.1", port), timeout=5.0) as http:
        http.sendall(b"GET /metrics HTTP/1.0\\r\\n\\r\\n")
        head, _, page = b"".join(iter(lambda: http.recv(65_536), b"")).partition(b"\\r\\n\\r\\n")
    assert b" 200 " in head.partition(b"\\r\\n")[0]
    return page
def work():
    began, done = time.monotonic(), 0
    while (now := time.monotonic() - began) < seconds:
        if done < now * rate / threads:
            asked, done = time.monotonic(), done + 1
            pages.add(scrape())
            took.append(time.monotonic() - asked)
        else:
            time.sleep(0.001)
all_ = [threading.Thread(target=work) for _ in range(threads)]
for each in all_:
    each.start()
for each in all_:
    each.join()
print(json.dumps({"scrapes": len(took), "longest": max(took), "pages": len(pages)}))
"""


def _scrape_time(run: Processes, name: str) -> float:
    """How long the metrics of a process take to be read [s]; NaN if they cannot be."""
    began = time.monotonic()
    try:
        run.scrape(name, timeout=1.0)
    except OSError:
        return nan
    return time.monotonic() - began


def _slow_scrapers(seed: int) -> Outcome:
    outcome = Outcome()
    with Processes(seed=seed) as run:
        run.reached(1)
        since = time.monotonic()
        ports = [port for port in run.metrics.values() for _ in range(SLOW)]
        slow = [socket.create_connection((LOOPBACK, port)) for port in ports]
        for each in slow:
            each.sendall(b"GET /metrics HTTP/1.1\r\n")  # and never an end
        took: dict[str, list[float]] = {name: [] for name in run.metrics}
        for _ in range(20):
            for name, times in took.items():
                times.append(_scrape_time(run, name))
            time.sleep(0.2)
        until = time.monotonic()
        for each in slow:
            each.close()
        for name, times in took.items():
            text = f"longest scrape of {name} beside {SLOW} slow ones"
            outcome.most(text, float(np.max(times)), 1.0, "s")
        flown = finish(outcome, run)
        outcome.same("HOLDs meanwhile", holds(flown, since, until), 0)
    return outcome


def _fast_scrapers(seed: int) -> Outcome:
    """The robot stays at its first waypoint meanwhile, so that the mission outlives the scrapes.

    How late world's ticks are meanwhile is no check: on two cores that the scraper shares, the 99th
    percentile differs between two calm runs by more than the scrapes add.
    """
    outcome = Outcome()
    dwell = f"mission.waypoints.1.dwell_s={SECONDS}"
    with Processes(dwell, "criteria.time_limit_s=120", seed=seed) as run:
        run.reached(1)
        since = time.monotonic()
        told = _scraped(run.metrics["world"])
        until = time.monotonic()
        outcome.least("scrapes answered per second", told["scrapes"] / SECONDS, 0.9 * RATE)
        outcome.most("longest scrape", told["longest"], 1.0, "s")
        outcome.most("of them pages made anew, per second", told["pages"] / SECONDS, 5.0)
        flown = finish(outcome, run)
        outcome.same("HOLDs meanwhile", holds(flown, since, until), 0)
    return outcome


def _scraped(port: int) -> dict[str, float]:
    """Scrape; what came: the scrapes, the longest of them [s], different pages."""
    command = [sys.executable, "-c", SCRAPER, *map(str, (port, RATE, SECONDS))]
    told = subprocess.check_output(command, timeout=10 * SECONDS)
    return dict[str, float](json.loads(told))


SCENARIOS = (
    Scenario(
        31,
        "slow-scrapers",
        f"{SLOW} clients that never end their request, at the metrics of each process",
        "a scrape is answered in < 1 s; no HOLD",
        "none",
        "nothing: every scrape is answered; if none were for two minutes, alert CloudrcAbsent "
        "(tests/e2e/alerts.yaml tries it)",
        _slow_scrapers,
        REAL,
    ),
    Scenario(
        31,
        "fast-scrapers",
        f"{RATE} scrapes of world per second, of which each by itself would have a page made",
        "at most four pages are made a second, a scrape is answered in < 1 s; no HOLD",
        "none",
        "nothing: every scrape is answered, by what was known 0.25 s ago at most",
        _fast_scrapers,
        REAL,
    ),
)
