"""How long STOP takes, from the click in a browser to rotors that are off: nightly.

The end of a trial is the first status of teleop's API that tells ESTOP. The measured time contains
the telemetry's way back, so that the rotors stop earlier.
"""

import os
import subprocess
import sys
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest

from cloudrc.messages import GuardState
from cloudrc.teleop.client import Api
from tests.conftest import wait_until
from tests.console.conftest import acknowledge, session_with_console

pytestmark = [pytest.mark.process, pytest.mark.alone, pytest.mark.full]
CLICKS = int(os.environ.get("CLOUDRC_STOP_CLICKS", "200"))
"""Clicks on the ground in each row; a tenth of them in flight."""
ROWS = {"idle": (0, 0.150), "busy processors": (os.cpu_count(), 0.400)}
"""Name -> number of busy processes, and bound of p99 [s]."""
CLICK = """() => {
  const at = performance.timeOrigin + performance.now();
  document.querySelector('#stop button').click();
  return at;
}"""


class Watch:
    """Reads the robot's statuses; knows when the guard last changed [s], wall clock."""

    def __init__(self, url):
        self.guard, self.position, self.since = None, None, 0.0
        self._url = url
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self):
        for status in Api(self._url).robot():
            if status is None:
                continue
            self.position = status.position
            if status.guard is not self.guard:
                self.since, self.guard = time.time(), status.guard


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session, its API, its watch, and the address of its console."""
    with session_with_console(tmp_path_factory, "--no-open") as (api, _, console):
        yield api, Watch(api.url), console.stdout.readline().split()[-1]


@contextmanager
def load(count):
    """Keep processors busy."""
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def land(api, watch):
    """Acknowledge the stop; the robot is on the ground afterwards."""
    wait_until(lambda: watch.guard is GuardState.ESTOP)
    wait_until(lambda: not api.get("/v1/state")["mission"])
    acknowledge(api)
    wait_until(lambda: watch.guard is not GuardState.ESTOP)


def fly(api, watch):
    """Fly 0.5 m above the ground."""
    order = {"waypoints": [{"position_m": (0.0, 0.0, 0.8)}, {"position_m": (0.5, 0.0, 0.8)}]}
    api.post("/v1/missions", order)
    wait_until(lambda: watch.guard is GuardState.TRACK and watch.position[2] > 0.5)


@pytest.mark.parametrize("name", ROWS)
def test_stop_is_quick_on_the_ground_and_in_flight(name, session, browse, figure):
    api, watch, address = session
    count, bound = ROWS[name]
    page = browse(address.replace("/?", "/plain?"))
    with load(count):
        for where, clicks in (("on the ground", CLICKS), ("in flight", max(1, CLICKS // 10))):
            took = []
            for _ in range(clicks):
                if where == "in flight":
                    fly(api, watch)
                at = page.evaluate(CLICK) * 1e-3
                wait_until(lambda: watch.guard is GuardState.ESTOP)
                took.append(watch.since - at)
                land(api, watch)
            middle, worst = np.percentile(took, [50, 99])
            print(f"STOP, {name}, {where}: p50 {middle:.3f} s, p99 {worst:.3f} s, {clicks} clicks")
            figure(f"STOP, {name}, {where}: p50", middle, "<=", bound, "s", count=clicks)
            figure(f"STOP, {name}, {where}: p99", worst, "<=", bound, "s", count=clicks)
