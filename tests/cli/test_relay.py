"""`cloudrc relay`: its profiles, its addresses."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path

import pytest

from cloudrc.cli.processes import open_relay, read_profiles
from cloudrc.config.load import load_experiment
from cloudrc.errors import BadInputError
from cloudrc.link.model import LinkDirection
from cloudrc.link.profile import DirectionProfile
from cloudrc.link.state import summary


def test_the_requested_delay_is_that_of_the_trace(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("time_s,delay_ms\n0,40\n5,90\n")
    mine = tmp_path / "mine.yaml"
    mine.write_text("link: {uplink: {trace: t.csv}, downlink: {delay_ms: 25}}\n")
    first = read_profiles(load_experiment(str(mine)))
    delays = {way: summary(loaded.direction)["delay"] for way, loaded in first.items()}
    assert delays == {"uplink": 0.04, "downlink": 0.025}


def test_a_side_that_cannot_reach_its_end_is_refused() -> None:
    options = Namespace(
        world_side=("127.0.0.1", 0),
        cloud_side=("127.0.0.1", 0),
        world=("198.51.100.7", 7400),
        cloud=("127.0.0.1", 7400),
    )
    links = [LinkDirection(DirectionProfile(), 1, uplink) for uplink in (True, False)]
    with pytest.raises(BadInputError, match="cannot reach --world from --world-side"):
        open_relay(options, *links)
