# SPDX-License-Identifier: Apache-2.0

"""Fixtures: a pair of Unix sockets, this machine's speed, and a release of three processes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from cloudrc.base.errors import CloudrcError
from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import dump
from cloudrc.flight.pod.realtime import free_ports
from cloudrc.flight.pod.teleop_link import UnixPeer
from cloudrc.teleop.client import Api
from cloudrc.wire.messages import GuardState
from tests.conftest import wait_until


@pytest.fixture
def peers(tmp_path):
    """Make teleop's and cloud's socket, in the order that a test chooses."""
    paths = tmp_path / "a.sock", tmp_path / "b.sock"
    pair = [UnixPeer(*each) for each in (paths, paths[::-1])]
    yield pair
    for peer in pair:
        peer.close()


WORK = """
from time import process_time
def work():
    table = {}
    began = process_time()
    for i in range(2_000_000):
        table[i & 1023] = i * i % 977
    return process_time() - began
print(min(work() for _ in range(5)))
"""
NOMINAL = 0.100
"""Time of WORK on a machine where a release in flight costs 138m to 148m of CPU [s]. With 0.17 to
0.21 s the same release cost 228m to 300m."""


def slower(told):
    """Compute the slowdown of an interpreter against nominal from what `WORK` told; at least 1."""
    return max(1.0, float(told) / NOMINAL)


def ages_at_hold(recording):
    """Return the age [s] of the newest applied basis at each HOLD for want of fresh commands."""
    guard, applied = recording["/guard"], recording["/command_applied"]
    ages = []
    for stamp_ns, state, cause in zip(
        *(guard[name].tolist() for name in ("stamp_ns", "state", "cause")), strict=True
    ):
        if state == GuardState.HOLD and "age" in cause:
            before = applied["basis_stamp_ns"][applied["stamp_ns"] <= stamp_ns]
            ages.append((stamp_ns - int(before.max())) * 1e-9)
    return ages


COMMAND = [sys.executable, "-m", "cloudrc"]


def start(folder, *settings, dwell=20.0, report="none"):
    """Start a local run of `hover`."""
    words = ["run", "hover", "--mode", "local", "--out", str(folder), "--report", report]
    for setting in (f"mission.waypoints.0.dwell_s={dwell}", *settings):
        words += ["--set", setting]
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [*COMMAND, *words], stdout=pipe, stderr=pipe, text=True, start_new_session=True
    )


def wait_until_flying(run):
    """Return the process ids by role: world, teleop, cloud, uplink, downlink."""
    for line in run.stdout:
        if "mission started" in line:
            break
    else:
        raise AssertionError(run.stderr.read())
    return processes_of(run)


def processes_of(run):
    """Return the ids of a run's processes by role."""
    found = {}
    for children in Path(f"/proc/{run.pid}/task").glob("*/children"):
        for pid in children.read_text().split():
            line = Path(f"/proc/{pid}/cmdline").read_text().split("\0")
            ways = [word.removeprefix("--direction=") for word in line if "--direction=" in word]
            role = ways[0] if ways else line[line.index("process") + 1]
            found[role] = int(pid)
    return found


LIMIT = 30.0
TOKEN = "operator-token-of-the-tests"
KEY = bytes(range(100, 132))
WAYPOINT = "  - {position_m: [0.5, %s, 0.7], tolerance_m: 0.2, dwell_s: 0.0}\n"
MISSION = "waypoints:\n" + "".join(WAYPOINT % y for y in ("0.0", "3.6", "3.0"))


class Release:
    """A release without its link: three processes, a journal, an API, two recordings."""

    def __init__(self, folder):
        self.folder, self.running, self.all = folder, {}, []
        world, cloud = (f"127.0.0.1:{port}" for port in free_ports(2))
        (folder / "config.yaml").write_text(dump(load_experiment("paper")))
        (folder / "key").write_bytes(KEY)
        (folder / "mission.yaml").write_text(MISSION)
        (folder / "operator").write_text(TOKEN)
        (folder / "operator").chmod(0o600)
        for end, peer in (("world", cloud), ("cloud", world)):
            (folder / f"{end}.route").write_text(peer)
        self.flags = {
            "world": ["--listen", world, "--route", "world.route", "--key", "key"],
            "cloud": ["--listen", cloud, "--route", "cloud.route", "--key", "key", "--teleop", "."],
            "teleop": ["--socket", ".", "--api", "0", "--api-file", "api.json", "--tokens", ".",
                       "--journal", "journal/missions"],
        }  # fmt: skip
        for end in ("world", "cloud"):
            self.flags[end] += ["--record", f"{end}.mcap"]
        for name in self.flags:
            self.start(name)
        self.until(lambda: self.ask("/v1/state")["seen"] is not None)

    def start(self, name):
        if name == "teleop":
            (self.folder / "api.json").unlink(missing_ok=True)
        self.running[name] = self.run("process", name, "--config", "config.yaml", *self.flags[name])

    def run(self, *words):
        environ = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
        how = {"cwd": self.folder, "env": environ, "text": True}
        command = [sys.executable, "-m", "cloudrc", *words]
        # A file: teleop logs each command, and nobody reads while it flies.
        with open(self.folder / f"{len(self.all)}.log", "w") as log:
            self.all.append(subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, **how))
        return self.all[-1]

    def kill(self, *names):
        for name in names:
            self.running[name].kill()
            self.running[name].communicate(timeout=10)

    def freeze(self, name, duration):
        """Let a process stand still for `duration` [s]."""
        self.running[name].send_signal(signal.SIGSTOP)
        time.sleep(duration)
        self.running[name].send_signal(signal.SIGCONT)

    def end(self):
        for process in self.all:
            process.kill()
            process.communicate()

    @property
    def url(self):
        return json.loads((self.folder / "api.json").read_text())["url"]

    def ask(self, path):
        try:
            return Api(self.url, lambda: TOKEN).get(path)
        except (OSError, ValueError, CloudrcError):
            return {"seen": None, "missions": []}

    def post(self, path, *body):
        return Api(self.url, lambda: TOKEN).post(path, *body)

    def mission(self):
        """Return the newest mission, if there is one."""
        missions = self.ask("/v1/missions")["missions"]
        return missions[-1] if missions else {"state": "away", "reached": []}

    def until(self, condition):
        wait_until(condition, LIMIT)

    def until_guard(self, state):
        self.until(lambda: self.ask("/v1/state")["seen"]["guard"] == state)

    def fly(self):
        """Start the command of a Job and wait for its first waypoint."""
        flags = ["--token-file", "operator", "--mission", "mission.yaml", "--key", "u"]
        job = self.run("mission", "fly", "--api", self.url, *flags)
        self.until(lambda: len(self.mission()["reached"]) == 1)
        return job

    def stop(self, *names):
        """End processes, by default all, at the same time; return their outputs."""
        ended, asked = [self.running[name] for name in names or self.running], time.monotonic()
        for process in ended:
            process.send_signal(signal.SIGTERM)
        said = [process.communicate(timeout=10)[0] for process in ended]
        assert time.monotonic() - asked < (2.0 if names else 10.0)
        return said
