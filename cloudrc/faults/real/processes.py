"""World, cloud and teleop as processes of this machine, for a scenario to kill, stop and flood."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from cloudrc.cluster.pods import NO_PROXY
from cloudrc.config.load import dump, load_experiment
from cloudrc.drivers.epochs import replace_durably
from cloudrc.drivers.realtime import free_ports
from cloudrc.errors import TimedOutError
from cloudrc.faults.flight import SECRET
from cloudrc.record.columns import Recording
from cloudrc.record.recover import Recovery, recover
from cloudrc.teleop.store import ENDED, STATES
from cloudrc.tunnel import codec
from cloudrc.tunnel.codec import Direction, Kind
from cloudrc.tunnel.keys import write

LIMIT = 60.0
"""For whatever is waited for [s]."""
LOOPBACK = "127.0.0.1"
NAMES = ("world", "cloud", "teleop")
PERIOD = 0.05
"""Between two looks at whether something has come about [s]."""


class Processes:
    """A robot and its cloud, joined by loopback, without an emulated link.

    Attributes:
        folder: With configuration, key, journal and recordings.
        ports: Of the tunnel, UDP, by end.
        metrics: Ports of the metrics, TCP, by process.
        running: The process of each name that was started last.
    """

    def __init__(self, *settings: str, seed: int = 1, teleop: Sequence[str] = ("--start",)) -> None:
        """Start all three.

        Args:
            settings: Over the experiment `paper`, as `--set` takes them.
            seed: Of the experiment.
            teleop: Flags of the first teleop; by default it begins the experiment's mission.
        """
        self._temporary = tempfile.TemporaryDirectory(prefix="cloudrc-")
        self.folder = Path(self._temporary.name)
        experiment = load_experiment("paper", [*settings, f"seed={seed}"])
        (self.folder / "config.yaml").write_text(dump(experiment), encoding="utf-8")
        replace_durably(self.folder / "key", write(SECRET).encode())
        self.ports = dict(zip(("world", "cloud"), free_ports(2), strict=True))
        self.metrics = dict(zip(NAMES, free_ports(len(NAMES), socket.SOCK_STREAM), strict=True))
        self.running: dict[str, subprocess.Popen[bytes]] = {}
        self._all: list[subprocess.Popen[bytes] | subprocess.Popen[str]] = []
        self._recordings = 0
        self.start("teleop", *teleop)
        self.start("world")
        self.start("cloud")

    def start(self, name: str, *more: str) -> None:
        """Start a process; one that is started again has a recording of its own."""
        self._recordings += 1
        record = ["--record", f"{name}-{self._recordings}.mcap"]
        here, there = (f"{LOOPBACK}:{self.ports[end]}" for end in ("world", "cloud"))
        flags = {
            "world": [
                *("--listen", here, "--peer", there, "--key", "key", "--epochs", "epochs", *record),
            ],
            "cloud": [
                *("--listen", there, "--peer", here, "--key", "key", "--teleop", ".", *record),
            ],
            "teleop": ["--socket", ".", "--journal", "journal"],
        }
        metrics = f"{LOOPBACK}:{self.metrics[name]}"
        command = [sys.executable, "-m", "cloudrc", name, "--config", "config.yaml"]
        command += ["--metrics", metrics]
        with (self.folder / f"{name}.log").open("ab") as log:
            process = subprocess.Popen(
                [*command, *flags[name], *more],
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
            )
        self.running[name] = process
        self._all.append(process)

    def order(self, *flags: str) -> subprocess.Popen[str]:
        """Start what a mission's Job runs, to fly the paper's mission; it tells what happens."""
        command = [sys.executable, "-m", "cloudrc", "mission", "fly", "--mission", "pipes", *flags]
        process = subprocess.Popen(
            command,
            cwd=self.folder,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        self._all.append(process)
        return process

    def send(self, name: str, number: signal.Signals) -> None:
        """Send a signal to a process."""
        self.running[name].send_signal(number)

    def kill(self, name: str) -> float:
        """SIGKILL; return when that was [s, monotonic clock]."""
        self.running[name].kill()
        killed = time.monotonic()
        self.running[name].wait(LIMIT)
        return killed

    def end(self, *names: str) -> dict[str, float]:
        """SIGTERM of all at once; return within how long each had ended [s]."""
        began = time.monotonic()
        for name in names:
            self.send(name, signal.SIGTERM)
        took = {}
        for name in names:
            self.running[name].wait(LIMIT)
            took[name] = time.monotonic() - began
        return took

    def events(self) -> list[str]:
        """What has happened to the mission, as the journal has it."""
        import json
        import shutil
        import sqlite3

        with tempfile.TemporaryDirectory() as folder:  # teleop has the files locked
            for path in self.folder.glob("journal*"):
                shutil.copy(path, folder)
            try:
                database = sqlite3.connect(Path(folder) / "journal")
                rows = database.execute("SELECT body FROM event ORDER BY id").fetchall()
                database.close()
            except sqlite3.DatabaseError:
                return []
        return [str(json.loads(body)["event"]) for (body,) in rows]

    def until(self, text: str, condition: Callable[[], bool], limit: float = LIMIT) -> None:
        """Wait until something has come about.

        Args:
            text: What, in words.
            condition: Whether it has.
            limit: For how long [s].

        Raises:
            TimedOutError: If it does not.
        """
        end = time.monotonic() + limit
        while not condition():
            if time.monotonic() > end:
                raise TimedOutError(f"{text}: not within {limit:g} s; {self._last_words()}")
            time.sleep(PERIOD)

    def reached(self, count: int) -> None:
        """Wait until so many waypoints are reached."""
        self.until(f"{count} waypoints reached", lambda: self.events().count("reached") >= count)

    def over(self) -> None:
        """Wait until the mission has ended."""
        ended = lambda: any(STATES.get(event) in ENDED for event in self.events())  # noqa: E731
        self.until("the mission ended", ended, 2 * LIMIT)

    def recording(self, name: str, which: int = -1) -> tuple[Recording, Recovery]:
        """Recover a recording of a process and read it; by default the newest."""
        path = self.recording_path(name, which)
        clean = self.folder / f"{path.stem}.recovered-{time.monotonic_ns()}.mcap"
        recovery = recover(path, clean)
        return Recording.read(clean), recovery

    def recording_path(self, name: str, which: int = -1) -> Path:
        """Find a recording of a process; by default the newest."""
        paths = sorted(self.folder.glob(f"{name}-*.mcap"), key=lambda path: path.stat().st_ctime)
        return [path for path in paths if "recovered" not in path.name][which]

    def log(self, name: str) -> str:
        """What a process has said."""
        return (self.folder / f"{name}.log").read_text(errors="replace")

    def scrape(self, name: str = "world", timeout: float = 5.0) -> dict[str, float]:
        """Read the metrics of a process [any unit].

        Args:
            name: Of the process.
            timeout: For the answer [s].
        """
        url = f"http://{LOOPBACK}:{self.metrics[name]}/metrics"
        with NO_PROXY.open(url, timeout=timeout) as answer:
            lines = answer.read().decode().splitlines()
        samples = (line.rpartition(" ") for line in lines if not line.startswith("#"))
        return {name: float(value) for name, _, value in samples}

    def slip(self) -> float:
        """By how much world's clock lags the machine's monotonic one, by its metric [s]."""
        return self.scrape()["cloudrc_world_slip_seconds_total"]

    def close(self) -> None:
        """End everything and forget the folder."""
        for process in self._all:
            process.kill()
            process.wait()
        self._temporary.cleanup()

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def _last_words(self) -> str:
        words = []
        for name in self.running:
            lines = self.log(name).splitlines()
            words.append(f"{name}: {lines[-1] if lines else 'nothing'}")
        return "; ".join(words)


FLOOD = """
import os, random, socket, struct, sys, time
port, rate, seconds, version, direction, kind, size = map(int, sys.argv[1:])
udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
def noise(n):  # pure; behind a right head, too short; as long as an honest one, of an early epoch
    if n % 3 == 0:
        return os.urandom(16 + n % 200)
    epoch, generation = 1 + n % 2, n // 2 % 2
    number = random.getrandbits(40)
    head = struct.pack("<BBIBBQ", version, direction, epoch, generation, kind, number)
    return head + os.urandom(n % 40 if n % 3 == 1 else size - len(head))
began, sent = time.monotonic(), 0
while (now := time.monotonic() - began) < seconds:
    while sent < now * rate:
        udp.sendto(noise(sent), ("127.0.0.1", port))
        sent += 1
    time.sleep(0.001)
print(sent)
"""


def flood(port: int, way: Direction, rate: int, seconds: int) -> subprocess.Popen[bytes]:
    """Send garbage to a port of the loopback.

    Args:
        port: Of an end.
        way: That honest datagrams go to get there; a part of the garbage looks like them.
        rate: Datagrams per second [1/s].
        seconds: For so long [s].
    """
    kind = Kind.COMMAND if way is Direction.DOWNLINK else Kind.TELEMETRY
    form = (codec.VERSION, int(way), int(kind), codec.SIZES[kind])
    command = [sys.executable, "-c", FLOOD, *map(str, (port, rate, seconds, *form))]
    return subprocess.Popen(command, stdout=subprocess.PIPE)


def throttle(pid: int, share: float, period: float = 0.1) -> Path | None:
    """Give a process a share of a processor, by a cgroup.

    Args:
        pid: Of the process.
        share: In [0, 1]; of a period it is at least 1 ms.
        period: In which it has its share at once, and then waits [s], 1 at most.

    Returns:
        The cgroup, or None if that is not allowed.
    """
    period_us, quota_us = round(period * 1e6), round(share * period * 1e6)
    first = {"cpu.cfs_period_us": f"{period_us}", "cpu.cfs_quota_us": f"{quota_us}"}
    second = {"cpu.max": f"{quota_us} {period_us}"}
    for root, settings in (("/sys/fs/cgroup/cpu", first), ("/sys/fs/cgroup", second)):
        group = Path(root) / f"cloudrc-{pid}"
        try:
            group.mkdir()
            for name, value in settings.items():
                (group / name).write_text(value)
            (group / "cgroup.procs").write_text(str(pid))
        except OSError:
            if group.exists():
                group.rmdir()
            continue
        return group
    return None


def throttled(group: Path) -> int:
    """In how many periods a cgroup has used its quota up."""
    lines = (group / "cpu.stat").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("nr_throttled "))


def release(group: Path, pid: int) -> None:
    """Take a process out of its cgroup, and the cgroup away."""
    (group.parent / "cgroup.procs").write_text(str(pid))
    group.rmdir()
