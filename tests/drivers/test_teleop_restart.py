"""World, cloud and teleop as processes, each of which may be killed in flight."""

import json
import os
import signal
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from cloudrc.config.load import dump, load_experiment
from cloudrc.drivers.local import _free_addresses

pytestmark = pytest.mark.process

LIMIT = 30.0
MISSION = """
waypoints:
  - {position_m: [0.5, 0.0, 0.7], tolerance_m: 0.2, dwell_s: 0.0}
  - {position_m: [0.5, 3.6, 0.7], tolerance_m: 0.2, dwell_s: 0.0}
  - {position_m: [0.5, 0.0, 0.7], tolerance_m: 0.2, dwell_s: 0.0}
"""


class Release:
    """What a release has, without its link: three processes, a journal, an API."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.running, self.all = folder, {}, []
        self.world, self.cloud = _free_addresses(2)
        (folder / "config.yaml").write_text(dump(load_experiment("paper")))
        (folder / "mission.yaml").write_text(MISSION)
        for name in ("world", "cloud", "teleop"):
            self.start(name)
        self.until(lambda: self.ask("/v1/state")["seen"] is not None)

    def start(self, name: str) -> None:
        flags = {
            "world": ["--listen", self.world, "--peer", self.cloud],
            "cloud": ["--listen", self.cloud, "--peer", self.world, "--teleop", "."],
            "teleop": ["--socket", ".", "--api", "127.0.0.1:0", "--api-file", "api.json",
                       "--journal", "journal/journal.jsonl"],
        }  # fmt: skip
        (self.folder / "api.json").unlink(missing_ok=True) if name == "teleop" else None
        self.running[name] = self.run(name, "--config", "config.yaml", *flags[name])

    def run(self, *words: str) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "cloudrc", *words]
        environ = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
        pipe = subprocess.PIPE
        process = subprocess.Popen(
            command, cwd=self.folder, stdout=pipe, stderr=pipe, text=True, env=environ
        )
        self.all.append(process)
        return process

    def kill(self, *names: str) -> None:
        for name in names:
            self.running[name].kill()
            self.running[name].communicate()

    def end(self) -> None:
        for process in self.all:
            process.kill()
            process.communicate()

    def ask(self, path: str):
        try:
            url = json.loads((self.folder / "api.json").read_text())["url"]
            with urllib.request.urlopen(url + path, timeout=2.0) as answer:
                return json.loads(answer.read())
        except urllib.error.HTTPError as error:
            error.close()
        except (OSError, ValueError):
            pass
        return {"seen": None, "missions": []}

    def mission(self):
        """The newest one, if there is any."""
        missions = self.ask("/v1/missions")["missions"]
        return missions[-1] if missions else {"state": "away", "reached": []}

    def until(self, condition) -> None:
        limit = time.monotonic() + LIMIT
        while not condition():
            assert time.monotonic() < limit, "not in time"
            time.sleep(0.05)

    def fly(self) -> "subprocess.Popen[str]":
        """What a Job runs, once it has reached its first waypoint."""
        url = json.loads((self.folder / "api.json").read_text())["url"]
        job = self.run("mission", "fly", "--api", url, "--mission", "mission.yaml", "--key", "u")
        self.until(lambda: len(self.mission()["reached"]) == 1)
        return job

    def stop(self) -> dict[str, float]:
        took = {}
        for name, process in self.running.items():
            began = time.monotonic()
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=10)
            took[name] = time.monotonic() - began
        return took


@pytest.fixture
def release(tmp_path):
    one = Release(tmp_path)
    yield one
    one.end()


@pytest.mark.parametrize("killed", [("teleop",), ("cloud",), ("cloud", "teleop")])
def test_the_mission_goes_on_at_the_same_waypoint(release, killed):
    release.fly()
    release.kill(*killed)
    for name in killed:
        release.start(name)
    release.until(lambda: release.mission()["state"] == "done")
    view = release.ask(f"/v1/missions/{release.mission()['id']}")
    assert [reached["waypoint"] for reached in view["reached"]] == [0, 1, 2]
    # A machine that is busy with other things is no failure of this.
    assert {failure["code"] for failure in view["verdict"]["failures"]} <= {"not_real_time"}
    names = [event["event"] for event in view["events"]]
    assert names.count("started") == 1
    assert names.count("resumed") == ("teleop" in killed)


def test_a_world_that_is_killed_ends_the_job_with_world_restarted(release):
    job = release.fly()
    release.kill("world")
    release.start("world")
    out, _ = job.communicate(timeout=LIMIT)
    assert job.returncode == 1
    assert "world_restarted" in out.splitlines()[-1]


def test_a_second_teleop_waits_for_the_journal_and_takes_over(release):
    release.fly()
    first = release.running["teleop"]
    old = (release.folder / "api.json").read_text()
    release.start("teleop")
    release.until(lambda: (release.folder / "api.json").exists())
    url = json.loads((release.folder / "api.json").read_text())["url"]
    assert url != json.loads(old)["url"]
    with pytest.raises(urllib.error.HTTPError, match="503") as refused:
        urllib.request.urlopen(f"{url}/v1/state", timeout=2.0)
    refused.value.close()
    first.send_signal(signal.SIGTERM)
    first.communicate(timeout=2.0)
    release.until(lambda: release.mission()["state"] == "done")


def test_all_end_within_two_seconds_of_sigterm(release):
    release.fly()
    assert max(release.stop().values()) < 2.0
