# SPDX-License-Identifier: Apache-2.0

"""`make bench` compares flights fairly: enough of them, and the shortest time of each piece."""

import numpy as np
import pytest

from tools import bench


def test_too_few_flights_are_refused(monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["bench", "--flights", "11"])
    with pytest.raises(SystemExit, match="2"):
        bench.main()
    assert "at least 12 flights" in capsys.readouterr().err


def measured(disturbed):
    """Return 12 flights of 3 pieces; other programs disturb some pieces of each."""
    pieces = np.full((12, 3), 0.010)
    pieces[disturbed] = 0.5
    return bench.Measured(pieces, 0.3, "")


def test_a_piece_costs_what_its_shortest_flight_does():
    calm, busy = measured([]), measured((np.arange(12), np.arange(12) % 3))
    assert busy.cost() == calm.cost() == pytest.approx(0.1)
    low, high = bench.interval(busy, calm)
    assert low == pytest.approx(1.0)
    assert high < 1.1, "12 flights are enough"
    assert bench.row("x", busy, calm, 0.9)[3::2] == ("1.000", "<= 0.9")
