"""Hostile datagrams: no exception escapes, none is accepted, memory stays flat."""

import platform
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.tunnel.hostile import Target, memory


@pytest.fixture(scope="module")
def target():
    return Target()


def flood(target, count, seed):
    """Try `count` random datagrams."""
    rng = random.Random(seed)
    for _ in range(count):
        target.try_one(rng.randbytes(rng.choice((6, 8, 12, 40, 200))))
    target.check()


def test_hostile_datagrams_are_not_accepted():
    target = Target(pace=300)
    flood(target, 30_000, seed=4)
    assert target.tried > 25_000
    assert target.world._counts["unanswered"] > 0
    assert target.now_ns > 1000e9, "time passes between them"


def test_the_check_finds_accepted_hostile_datagrams():
    target = Target()
    fresh = target.frames[-6]
    target.world.receive_datagram(fresh, 0)
    with pytest.raises(AssertionError, match="let through"):
        target.check()


needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="needs Linux: /proc")


@needs_linux
@pytest.mark.process
def test_a_million_hostile_datagrams(target, figure):
    tried = target.tried
    flood(target, 100_000, seed=2)
    before = memory()
    flood(target, 902_000, seed=3)  # a few are valid frames, which are not tried
    grown, tried = memory() - before, target.tried - tried
    assert tried >= 1_000_000
    figure("hostile datagrams by chance: accepted", 0, "==", 0, count=tried)
    figure("hostile datagrams by chance: memory grown", grown, "<=", 2.0, "MiB")


@pytest.mark.process
@pytest.mark.parametrize(
    ("runs", "least"),  # the fuzzer also makes valid frames
    [(1_150_000, 1_000_000), pytest.param(11_500_000, 10_000_000, marks=pytest.mark.full)],
)
def test_coverage_guided_hostile_datagrams(runs, least, tmp_path, figure):
    if (sys.platform, platform.machine()) != ("linux", "x86_64"):
        pytest.skip("atheris has wheels for Linux on x86_64 alone")
    command = [sys.executable, str(Path(__file__).with_name("hostile.py"))]
    command += [f"-atheris_runs={runs}", "-seed=1", "-max_len=256", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    said = done.stdout + done.stderr
    found = re.search(r"hostile (\d+) accepted 0 memory \+?(-?[\d.]+) MiB", said)
    assert found, said[-3000:]
    tried, grown = int(found.group(1)), float(found.group(2))
    assert tried >= least
    figure("hostile datagrams by coverage: accepted", 0, "==", 0, count=tried)
    figure("hostile datagrams by coverage: memory grown", grown, "<=", 20.0, "MiB")
