"""The same experiment and seed give identical records, for any clocks."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.record.columns import Recording
from tests.flights.conftest import digest, records

SHORT = ("mission.waypoints=[{position_m: [0.5, 0, 0.7], dwell_s: 1.0}]", "criteria.contact=false")
ROOT = Path(__file__).resolve().parents[2]
PRINT = """
from cloudrc.config.load import load_experiment
from tests.flights.conftest import digest
print(digest(load_experiment('paper', {settings!r})))
"""


def short(*settings):
    return load_experiment("paper", (*SHORT, *settings))


@pytest.mark.promise("one-seed-one-run")
def test_the_same_seed_gives_the_same_records_and_another_others():
    assert digest(short()) == digest(short()) != digest(short("seed=2"))


@pytest.mark.promise("one-seed-one-run")
def test_another_process_gives_the_same_records():
    command = [sys.executable, "-c", PRINT.format(settings=SHORT)]
    env = os.environ | {"PYTHONHASHSEED": "77", "PYTHONPATH": str(ROOT)}
    printed = subprocess.run(command, env=env, capture_output=True, text=True, check=True).stdout
    assert printed.strip() == digest(short())


@pytest.mark.full
def test_twenty_runs_give_the_same_records():
    experiment = load_experiment("paper")
    assert len({digest(experiment) for _ in range(20)}) == 1


@pytest.mark.parametrize("offset_ns", [1_234_567_891, 86_400_000_000_000])
def test_the_clocks_of_the_ends_need_not_agree(offset_ns):
    """Cloud depends on ages only, never on the value of its clock."""
    shared, apart = records(short()), records(short(), offset_ns=offset_ns)
    ours = Recording.from_records(*shared)
    theirs = Recording.from_records(*apart, offset_ns=-offset_ns)
    for topic in ("/ground_truth", "/command_applied", "/estimated_odometry", "/pid"):
        assert len(ours[topic]) == len(theirs[topic]) > 0
        assert np.array_equal(ours[topic]["stamp_ns"], theirs[topic]["stamp_ns"])
    assert np.array_equal(ours["/ground_truth"]["position"], theirs["/ground_truth"]["position"])
    assert np.isnan(theirs["/uplink_delay"]["delay"]).all()
    assert not np.isnan(ours["/uplink_delay"]["delay"]).any()


def test_the_resolved_experiment_flies_the_same_run_again(tmp_path):
    from cloudrc.config.load import dump

    path = tmp_path / "config.yaml"
    path.write_text(dump(short("link.profile=lossy", "seed=5")))
    assert digest(load_experiment(path)) == digest(short("link.profile=lossy", "seed=5"))
