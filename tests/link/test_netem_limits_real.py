"""What netem makes of the rarer wishes, and what it cannot: measured in the kernel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cloudrc.errors import BadInputError
from cloudrc.link.netem import Netem
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.tc import try_netem
from tests.link import conftest as lab
from tests.link.conftest import WITHIN, Flow, measure
from tests.link.conftest import show as told

pytestmark = pytest.mark.netem


def test_a_long_queue_holds_what_the_rate_and_the_delay_need(shaped: Netem) -> None:
    """200 kbit/s and 300 ms: 38 packets of 200 bytes are under way beside the queue's 100."""
    shaped.follow_profile(DirectionProfile(delay=0.3, rate=200e3, queue_packets=100))
    flow = Flow()
    flow.send(130, 0.0)
    assert len(flow.settle().arrived) == 130
    flow = Flow()
    flow.send(800, 0.0)
    arrived = len(flow.settle(1.0).arrived)
    told("at once", sent=800, arrived=arrived)
    assert 138 <= arrived < 800


def test_what_is_corrupted_is_mostly_lost_by_the_checksum(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(corrupt=0.5))
    arrived = len(measure(1000, 0.002).arrived)
    told("corrupt 0.5 asked", lost=1 - arrived / 1000)
    assert 1 - arrived / 1000 == pytest.approx(0.5, abs=0.1)
    shaped.follow_profile(DirectionProfile())
    assert len(measure(100, 0.002).arrived) == 100


def test_netem_makes_next_to_nothing_of_a_correlation(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(delay=0.1, jitter=0.04, correlation=0.9))
    flow = measure(800, 0.004)
    ordered = flow.delays()[np.argsort(flow.numbers())]
    found = float(np.corrcoef(ordered[1:], ordered[:-1])[0, 1])
    told("correlation 0.9 asked", measured=found, deviation=ordered.std())
    assert found < 0.3, "then notes() may be silent about it"


def test_a_measured_distribution_is_applied(tables: Path, shaped: Netem) -> None:
    drawn = np.random.default_rng(5).choice(
        [-1.0, -0.8, 1.6, 2.0], size=2000, p=[0.3, 0.3, 0.3, 0.1]
    )
    values = tuple(np.sort((drawn - drawn.mean()) / drawn.std()).tolist())
    profile = DirectionProfile(delay=0.1, jitter=0.03, distribution="table", table=values)
    shaped.follow_profile(profile)
    delays = measure(600, 0.004).delays()
    near = np.abs(delays[:, None] - (0.1 + 0.03 * np.unique(values))).min(axis=1)
    told("four delays asked", mean=delays.mean(), deviation=delays.std(), off=np.median(near))
    assert np.median(near) < WITHIN
    assert delays.std() == pytest.approx(0.03, abs=0.004)


def test_what_tc_clamps_is_refused_and_the_old_conditions_stay(shaped: Netem) -> None:
    shaped.follow_profile(DirectionProfile(delay=0.03))
    before = lab.qdiscs()
    with pytest.raises(BadInputError, match=r"rate: asked 0\.5, in force 0"):
        shaped.follow_profile(DirectionProfile(rate=4.0))
    with pytest.raises(BadInputError, match="loss: asked 1e-11, in force 0"):
        shaped.follow_profile(DirectionProfile(loss=1e-11))
    assert lab.qdiscs() == before


def test_trying_netem_leaves_nothing(tables: Path) -> None:
    show = ("tc", "-n", lab.NEAR, "qdisc", "show", "dev", "lo")
    before = lab.sh(*show)
    try_netem(lab.run_near(tables))
    assert lab.sh(*show) == before
