"""A trace of a flight's delays gives the same delays when it is replayed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cloudrc.cli.link_record import TOPICS, one_way
from cloudrc.config.load import load_experiment
from cloudrc.link.logs import Direction, Packets, trace_of
from cloudrc.link.traces import read_trace, write_trace
from cloudrc.record.columns import Recording
from tests.flights.conftest import records

MINUTE = ["mission.steps.count=15", "guard.command_age_max_ms=1000"]
BOTH: tuple[Direction, ...] = ("uplink", "downlink")


def fly(*settings: str) -> tuple[Recording, dict[Direction, Packets]]:
    recording = Recording.from_records(*records(load_experiment("steps", [*MINUTE, *settings])))
    return recording, {way: one_way(recording, Path("flight"), way) for way in BOTH}


@pytest.fixture(scope="module")
def traces(tmp_path_factory: pytest.TempPathFactory) -> dict[Direction, Path]:
    """Fly over a bad link: jitter, losses and delay in bursts."""
    folder = tmp_path_factory.mktemp("traces")
    _, packets = fly("link.profile=lossy")
    for way in BOTH:
        (folder / f"{way}.csv").write_text(write_trace(trace_of(packets[way])))
    return {way: folder / f"{way}.csv" for way in BOTH}


@pytest.fixture(scope="module")
def replayed(traces: dict[Direction, Path]) -> tuple[Recording, dict[Direction, Packets]]:
    return fly("link.profile=ideal", *(f"link.{way}.trace={traces[way]}" for way in BOTH))


@pytest.mark.parametrize("way", BOTH)
def test_a_replayed_minute_gives_its_delays_again(
    way: Direction,
    traces: dict[Direction, Path],
    replayed: tuple[Recording, dict[Direction, Packets]],
) -> None:
    """In virtual time the link begins at 0, so each delay is compared with its row."""
    arrivals, trace = replayed[0][f"/{way}_delay"], read_trace(traces[way])
    assert trace.times[-1] > 59.0
    assert trace.losses is not None
    sent = arrivals["stamp_ns"] * 1e-9 - arrivals["delay"]
    inside = sent < trace.times[-1]
    rows = np.searchsorted(trace.times, sent[inside] + 1e-9, side="right") - 1
    asked, measured = np.array(trace.delays)[rows], arrivals["delay"][inside]
    assert len(measured) > 5000
    assert np.corrcoef(asked, measured)[0, 1] >= 0.98
    assert np.abs(asked - measured).max() < 1e-6
    assert np.array(trace.losses)[rows].max() == 0.0


@pytest.mark.parametrize("way", BOTH)
def test_a_replay_loses_what_the_flight_lost(
    way: Direction,
    traces: dict[Direction, Path],
    replayed: tuple[Recording, dict[Direction, Packets]],
) -> None:
    """Each packet has its own row, so runs of losses keep their length."""
    recording, packets = replayed
    trace, again = read_trace(traces[way]), packets[way]
    assert trace.losses is not None
    start = recording[TOPICS[way][0]]["stamp_ns"][0] * 1e-9
    sent = np.array(again.sent) + start
    rows = np.searchsorted(trace.times, sent + 1e-9, side="right") - 1
    steady = (sent > 2.0) & (sent < 58.0)
    assert (np.diff(rows[steady]) == 1).all()
    lost = np.array([delay is None for delay in again.delays])
    assert 200 < lost[steady].sum() < 600
    assert (lost == (np.array(trace.losses)[rows] == 1.0))[steady].all()
