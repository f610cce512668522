"""A trace of a flight's delays gives the same delays and losses when it is replayed."""

from pathlib import Path

import numpy as np
import pytest

from cloudrc.cli.link_record import TOPICS, one_way
from cloudrc.config.load import load_experiment
from cloudrc.link.logs import trace_of
from cloudrc.link.traces import read_trace, write_trace
from cloudrc.record.columns import Recording
from tests.flights.conftest import records

MINUTE = ["mission.steps.count=15", "guard.command_age_max_ms=1000"]
WAYS = ("uplink", "downlink")


def fly(*settings):
    recording = Recording.from_records(*records(load_experiment("steps", [*MINUTE, *settings])))
    return recording, {way: one_way(recording, Path("flight"), way) for way in WAYS}


@pytest.mark.parametrize("way", WAYS)
def test_a_replayed_minute_gives_its_delays_and_losses_again(way, tmp_path):
    """In virtual time the link begins at 0, so each packet is compared with its row."""
    _, flown = fly("link.profile=lossy")  # jitter, losses and delay in bursts
    path = tmp_path / f"{way}.csv"
    path.write_text(write_trace(trace_of(flown[way])))
    trace = read_trace(path)
    delays, losses = np.array(trace.delays), np.array(trace.losses)
    recording, packets = fly("link.profile=ideal", f"link.{way}.trace={path}")
    arrivals = recording[f"/{way}_delay"]
    sent = arrivals["stamp_ns"] * 1e-9 - arrivals["delay"]
    inside = sent < trace.times[-1]
    assert inside.sum() > 5000
    rows = rows_of(trace, sent[inside])
    assert np.abs(delays[rows] - arrivals["delay"][inside]).max() < 1e-6
    assert losses[rows].max() == 0.0
    # Each packet has its own row, so runs of losses keep their length.
    sent = np.array(packets[way].sent) + recording[TOPICS[way][0]]["stamp_ns"][0] * 1e-9
    steady, rows = (sent > 2.0) & (sent < 58.0), rows_of(trace, sent)
    assert (np.diff(rows[steady]) == 1).all()
    lost = np.array([delay is None for delay in packets[way].delays])
    assert 200 < lost[steady].sum() < 600
    assert (lost == (losses[rows] == 1.0))[steady].all()


def rows_of(trace, sent):
    return np.searchsorted(trace.times, sent + 1e-9, side="right") - 1
