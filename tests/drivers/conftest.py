"""Fixtures: a pair of Unix sockets, this machine's speed, and a release of three processes."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import yaml

from cloudrc.cli.client import Api
from cloudrc.config.load import dump, load_experiment
from cloudrc.drivers.realtime import free_ports
from cloudrc.drivers.teleop import UnixPeer
from cloudrc.errors import CloudrcError
from cloudrc.messages import GuardState


@pytest.fixture
def peers(tmp_path):
    """Make teleop's and cloud's socket, in the order that a test chooses."""
    paths = tmp_path / "a.sock", tmp_path / "b.sock"
    pair = UnixPeer(*paths), UnixPeer(*reversed(paths))
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


def here():
    """Measure the slowdown of this machine's interpreter."""
    return slower(subprocess.check_output([sys.executable, "-c", WORK]))


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


WITHOUT_PAGE = """
import sys
from cloudrc.cli.main import main
from cloudrc.report import write
whole = write.write_report
write.write_report = lambda *given, **more: whole(*given, **(more | {"page": False}))
sys.exit(main(sys.argv[1:]))
"""
FAST = [sys.executable, "-c", WITHOUT_PAGE]
"""`cloudrc` that writes no page with figures, which takes longer than a short flight."""

LIMIT = 30.0
TOKEN = "operator-token-of-the-tests"
KEY = bytes(range(100, 132))
MISSION = """
waypoints:
  - {position_m: [0.5, 0.0, 0.7], tolerance_m: 0.2, dwell_s: 0.0}
  - {position_m: [0.5, 3.6, 0.7], tolerance_m: 0.2, dwell_s: 0.0}
  - {position_m: [0.5, 0.0, 0.7], tolerance_m: 0.2, dwell_s: 0.0}
"""


class Release:
    """A release without its link: three processes, a journal, an API; some ends record."""

    def __init__(self, folder, *recorded):
        self.folder, self.running, self.all = folder, {}, []
        self.recorded = recorded
        self.world, self.cloud = (f"127.0.0.1:{port}" for port in free_ports(2))
        (folder / "config.yaml").write_text(dump(load_experiment("paper")))
        (folder / "key").write_bytes(KEY)
        (folder / "mission.yaml").write_text(MISSION)
        (folder / "operator").write_text(TOKEN)
        (folder / "operator").chmod(0o600)
        for name in ("world", "cloud", "teleop"):
            self.start(name)
        self.until(lambda: self.ask("/v1/state")["seen"] is not None)

    def start(self, name):
        flags = {
            "world": ["--listen", self.world, "--peer", self.cloud, "--key", "key"],
            "cloud": ["--listen", self.cloud, "--peer", self.world, "--key", "key",
                      "--teleop", "."],
            "teleop": ["--socket", ".", "--api", "0", "--api-file", "api.json", "--tokens", ".",
                       "--audit", "audit.jsonl", "--journal", "journal/missions"],
        }  # fmt: skip
        (self.folder / "api.json").unlink(missing_ok=True) if name == "teleop" else None
        record = ["--record", f"{name}.mcap"] if name in self.recorded else []
        self.running[name] = self.run(name, "--config", "config.yaml", *flags[name], *record)

    def run(self, *words):
        command = [sys.executable, "-m", "cloudrc", *words]
        environ = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
        pipe = subprocess.PIPE
        process = subprocess.Popen(
            command, cwd=self.folder, stdout=pipe, stderr=pipe, text=True, env=environ
        )
        self.all.append(process)
        return process

    def kill(self, *names):
        for name in names:
            self.running[name].kill()
            self.running[name].communicate()

    def freeze(self, name, duration):
        """Let a process stand still for `duration` [s]."""
        self.running[name].send_signal(signal.SIGSTOP)
        time.sleep(duration)
        self.running[name].send_signal(signal.SIGCONT)

    def end(self):
        for process in self.all:
            process.kill()
            process.communicate()

    def ask(self, path):
        try:
            url = json.loads((self.folder / "api.json").read_text())["url"]
            return Api(url, lambda: TOKEN).get(path)
        except (OSError, ValueError, CloudrcError):
            return {"seen": None, "missions": []}

    def post(self, path):
        url = json.loads((self.folder / "api.json").read_text())["url"]
        return Api(url, lambda: TOKEN).post(path)

    def mission(self):
        """Return the newest mission, if there is one."""
        missions = self.ask("/v1/missions")["missions"]
        return missions[-1] if missions else {"state": "away", "reached": []}

    def until(self, condition):
        limit = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < limit, "not in time"
            time.sleep(0.05)

    def fly(self):
        """Start the command of a Job and wait for its first waypoint."""
        url = json.loads((self.folder / "api.json").read_text())["url"]
        flags = ["--token-file", "operator", "--mission", "mission.yaml", "--key", "u"]
        job = self.run("mission", "fly", "--api", url, *flags)
        self.until(lambda: len(self.mission()["reached"]) == 1)
        return job

    def post_mission(self):
        url = json.loads((self.folder / "api.json").read_text())["url"]
        Api(url, lambda: TOKEN).post("/v1/missions", yaml.safe_load(
            (self.folder / "mission.yaml").read_text()))  # fmt: skip

    def stop(self):
        took = {}
        for name, process in self.running.items():
            began = time.monotonic()
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=10)
            took[name] = time.monotonic() - began
        return took
