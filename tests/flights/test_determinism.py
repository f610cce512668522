"""The same experiment and seed give identical records, for any clocks and on any wall clock."""

import os
import re
import subprocess
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from cloudrc.assembly import assemble
from cloudrc.config.load import dump, load_experiment
from cloudrc.messages import Passed
from cloudrc.record.columns import Recording
from cloudrc.record.hash import RecordHash
from tests.flights.conftest import LIMIT_NS, digest, fly_on, join, records
from tests.record.conftest import later

SHORT = ("mission.waypoints=[{position_m: [0.5, 0, 0.7], dwell_s: 1.0}]", "criteria.contact=false")
ROOT = Path(__file__).resolve().parents[2]
PACKAGE = sorted((ROOT / "cloudrc").rglob("*.py"))
PRINT = """
from cloudrc.config.load import load_experiment
from tests.flights.conftest import digest
print(digest(load_experiment('paper', {settings!r})))
"""


def short(*settings):
    return load_experiment("paper", (*SHORT, *settings))


@pytest.mark.promise("one-seed-one-run")
def test_the_same_seed_gives_the_same_records_in_any_process():
    command = [sys.executable, "-c", PRINT.format(settings=SHORT)]
    env = os.environ | {"PYTHONHASHSEED": "77", "PYTHONPATH": str(ROOT)}
    printed = subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout
    assert printed.strip() == digest(short()) == digest(short()) != digest(short("seed=2"))


def test_the_resolved_experiment_flies_the_same_run_again(tmp_path):
    path, flown = tmp_path / "config.yaml", short("link.profile=lossy", "seed=5")
    path.write_text(dump(flown))
    assert digest(load_experiment(path)) == digest(flown)


PLAN = ("cloud.predictor=model_based", "cloud.estimator=earliest", "cloud.plan_s=0.4")


@pytest.mark.parametrize(
    "settings",
    [
        *((f"link.profile={name}",) for name in ("paper-p2", "lossy", "ideal")),
        ("link.profile=paper-p3", *PLAN),
    ],
)
def test_messages_passed_without_bytes_make_the_same_records(settings):
    experiment = short(*settings)
    _, cloud, run = assemble(experiment)
    passed = RecordHash()
    for each in fly_on(run, LIMIT_NS, lambda: cloud.mission_over):
        passed.update(each)
    assert passed.hexdigest() == digest(experiment)


def test_a_link_that_damages_datagrams_gets_bytes():
    damaging = short("link.downlink.corrupt=0.2", "link.profile=ideal")
    for experiment, kind in ((short(), Passed), (damaging, bytes)):
        world, _, run = assemble(experiment)
        run.fly(lambda: False, 200_000_000, lambda of_world, of_cloud: None)
        world.handle_deadline(world.next_deadline_ns())
        assert {type(data) for data in world.take_datagrams()} == {kind}


def test_an_observed_robot_flies_the_same_flight():
    """Observers make the robot run in Python."""
    seen = []

    class Observer(Mock):
        def see_step(self, now_ns, *given):
            seen.append(now_ns)

    world, cloud, run = join(short())
    world.robot.observers.append(Observer())
    observed = RecordHash()
    for each in fly_on(run, LIMIT_NS, lambda: cloud.mission_over):
        observed.update(each)
    assert observed.hexdigest() == digest(short())
    assert seen == list(range(0, seen[-1] + 1, 2_000_000))


def test_the_clocks_of_the_ends_need_not_agree():
    """Cloud depends on ages only, never on the value of its clock."""
    offset_ns = 86_400_000_000_001
    ours = Recording.from_records(*records(short()))
    world, cloud = records(short(), offset_ns=offset_ns)
    theirs = Recording.from_records(world, later(cloud, -offset_ns))
    for topic in ("/ground_truth", "/command_applied", "/estimated_odometry", "/pid"):
        assert len(ours[topic]) > 0
        assert np.array_equal(ours[topic]["stamp_ns"], theirs[topic]["stamp_ns"])
    assert np.array_equal(ours["/ground_truth"]["position"], theirs["/ground_truth"]["position"])
    assert np.isnan(theirs["/uplink_delay"]["delay"]).all()


WALL = re.compile(
    r"\btime\.(time|time_ns|localtime|gmtime|ctime|strftime|CLOCK_REALTIME)\b"
    r"|from time import|\bdate(time)?\.(now|utcnow|today)\b"
)
"""What reads a wall clock."""
CONTROL_PATH = ("world/", "cloud/", "teleop/", "tunnel/", "link/", "endpoint", "drivers/")
ALLOWED = {
    # The kernel stamps datagrams and probes by this clock; only ages of 0 to 50 ms are used.
    *("link/relay.py", "link/verify/probe.py"),
    # Only people read these times.
    *("teleop/auth.py", "drivers/process.py", "link/sidecar.py"),
}


@pytest.mark.promise("wall-clock-does-not-matter")
def test_nothing_on_the_control_path_reads_a_wall_clock():
    for code in ("time.time()", "from time import time_ns", "datetime.date.today()"):
        assert WALL.search(code)
    assert not WALL.search("time.monotonic()")
    places = {path.relative_to(ROOT / "cloudrc").as_posix(): path for path in PACKAGE}
    mine = {place: path for place, path in places.items() if place.startswith(CONTROL_PATH)}
    assert len(mine) > 60
    assert {place for place, path in mine.items() if WALL.search(path.read_text())} == ALLOWED
