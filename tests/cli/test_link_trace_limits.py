"""Traces that the link's container names: regular files of limited size only."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from cloudrc.cli import processes
from cloudrc.config.load import load_experiment
from cloudrc.errors import BadInputError
from cloudrc.link.verify.monitor import Asked, LinkMonitor, Load


@pytest.fixture
def load(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Load:
    """The function with which an end loads the profile in link.json."""
    kept: list[Load] = []

    def begin(self: LinkMonitor, asked: Asked, path: Path | None, load: Load) -> None:
        kept.append(load)

    monkeypatch.setattr(LinkMonitor, "begin", begin)
    options = argparse.Namespace(link=None, route=tmp_path / "route")
    processes.link_monitor(options, load_experiment("paper"), uplink=False)
    return kept[0]


@pytest.mark.parametrize("key", ["trace", "table"])
def test_a_trace_named_by_the_link_is_read_within_bounds(
    tmp_path: Path, load: Load, key: str
) -> None:
    path, text = tmp_path / "trace.csv", "time_s,delay_ms\n0,45\n1,50\n"
    profile = {"uplink": {key: str(path), "distribution": "table" if key == "table" else "normal"}}
    path.write_text(text)
    assert load(profile)[0].trace or load(profile)[0].table
    path.write_text(text + "\n" * processes.TRACE_MAX)
    with pytest.raises(BadInputError, match="longer than 2097152 bytes; give a CSV file"):
        load(profile)
    profile["uplink"][key] = "/dev/null"  # an endless device would fill the memory
    with pytest.raises(BadInputError, match="not a file; give a CSV file"):
        load(profile)
