# SPDX-License-Identifier: Apache-2.0

"""Hostile datagrams: no exception escapes, none is accepted, memory stays flat."""

import platform
import random
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.wire.tunnel.hostile import Target


def test_hostile_datagrams_are_not_accepted():
    target, rng = Target(pace=300), random.Random(4)
    for _ in range(30_000):
        target.try_one(rng.randbytes(rng.choice((6, 8, 12, 40, 200))))
    target.check()
    assert target.tried > 25_000
    assert target.world.counts["unanswered"] > 0
    assert target.now_ns > 1000e9, "time passes between them"


def test_the_check_finds_accepted_hostile_datagrams():
    target = Target()
    fresh = target.frames[-4]
    target.world.receive_datagram(fresh, 0)
    with pytest.raises(AssertionError, match="let through"):
        target.check()


@pytest.mark.process
@pytest.mark.parametrize(
    ("runs", "least"),  # the fuzzer also makes valid frames
    [(600_000, 500_000), pytest.param(11_500_000, 10_000_000, marks=pytest.mark.full)],
)
def test_coverage_guided_hostile_datagrams(runs, least, tmp_path):
    if (sys.platform, platform.machine()) != ("linux", "x86_64"):
        pytest.skip("atheris has wheels for Linux on x86_64 alone")
    if find_spec("atheris") is None:
        pytest.skip("atheris comes with the extra deep; run: make .venv/deep")
    command = [sys.executable, str(Path(__file__).with_name("hostile.py"))]
    command += [f"-atheris_runs={runs}", "-seed=1", "-max_len=256", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    said = done.stdout + done.stderr
    found = re.search(r"hostile (\d+) accepted 0 memory \+?(-?[\d.]+) MiB", said)
    assert found, said[-3000:]
    tried, grown = int(found.group(1)), float(found.group(2))
    assert tried >= least
    assert grown <= 20.0, "memory [MiB]"
