# SPDX-License-Identifier: Apache-2.0

"""The figure of a sweep: its axes, its bands, and pairs from the same rows."""

import json

import pytest

from cloudrc.results.report.figures.bands import Panel, Point, draw
from cloudrc.results.report.figures.style import Look
from cloudrc.studies.compare import of_sweep
from cloudrc.studies.figure import draw_sweep
from cloudrc.studies.sweep import read_flights
from tests.support.sweeps import flown

UNITS = {"iae_mean": "m s"}
AXES = {"delay_ms": [20, 5, 10], "predictor": ["none", "kalman"], "gain": [[1, 2], [3, 4]]}


def sweep(folder, rows=None):
    """Write the rows of a sweep in another order than its grid; flights above 5 ms fail."""
    points = [(d, p, g, seed) for seed in (2, 1) for g in AXES["gain"] for d in (5, 10, 20)
              for p in ("kalman", "none")]  # fmt: skip
    lines = [
        {"key": str(n), "point": {"delay_ms": d, "predictor": p, "gain": g}, "seed": seed}
        | flown("success" if d == 5 else "failure", iae_mean=d + seed + 0.5 * (p == "none"))
        for n, (d, p, g, seed) in enumerate(points)
    ]
    folder.mkdir()
    summary = {"axes": AXES, "units": UNITS, "flights": 24, "files": {}}
    (folder / "sweep.json").write_text(json.dumps(summary))
    (folder / "rows.jsonl").write_text("".join(f"{json.dumps(line)}\n" for line in lines[:rows]))
    return folder


@pytest.fixture
def drawn(monkeypatch):
    """Replace drawing; return the arguments of `draw`."""
    kept = []
    monkeypatch.setattr("cloudrc.studies.figure.draw", lambda *what, look: kept.extend(what) or {})
    return kept


def test_numbers_go_along_x_in_order_and_failures_get_a_panel(tmp_path, drawn):
    _, caption = draw_sweep(*read_flights(sweep(tmp_path / "s"))[:2])
    (iae, success), x, names, by = drawn
    assert (iae.title, iae.unit, x, names, by) == ("iae mean", "m s", "delay_ms", [], "predictor")
    assert [point.x for point in iae.lines["kalman"]] == [5, 10, 20]
    assert [point.middle for point in iae.lines["none"]] == [7.0, 12.0, 22.0]
    assert [point.failed for point in iae.lines["none"]] == [False, True, True]
    assert [point.middle for point in success.lines["kalman"]] == [100, 0, 0]
    assert caption.endswith("Each point pools all values of gain.")


def test_names_along_x_keep_the_order_of_the_grid(tmp_path, drawn):
    draw_sweep(*read_flights(sweep(tmp_path / "s"))[:2], x="predictor", by="gain")
    assert drawn[1:] == ["predictor", ["none", "kalman"], "gain"]
    assert [*drawn[0][0].lines] == ["[1, 2]", "[3, 4]"]


def test_values_over_two_decades_have_a_logarithmic_axis_in_a_unit_between_them(drawn):
    rows = [
        {"point": {"delay_ms": delay}, "seed": 1} | flown("success", prediction_error_rms=error)
        for delay, error in ((0, 0.001), (100, 2.0))
    ]
    draw_sweep(rows, {"prediction_error_rms": "m"})
    (panel,) = drawn[0]
    assert (panel.title, panel.unit, panel.is_log) == ("prediction error, RMS", "mm", True)
    assert [point.middle for point in panel.lines["delay_ms"]] == [1.0, 2000.0]


@pytest.mark.parametrize(
    ("key", "words"),
    [
        ("link.both.delay_ms", "delay each way (ms)"),
        ("link.uplink.loss", "loss of the uplink"),
        ("cloud.predictor.share", "predictor share"),
        ("robots", "robots"),
    ],
)
def test_a_figure_has_words_in_place_of_keys_and_explains_hollow_markers(key, words, monkeypatch):
    monkeypatch.setattr("cloudrc.results.report.figures.bands.PRINT_KINDS", ("svg",))
    panel = Panel("error", "m", {"a": [Point(1.0, 1.0, 1.0, 1.0, failed=True)]}, is_log=True)
    svg = draw([panel], key, [], "cloud.predictor", look=Look())["svg"].decode()
    for text in (words, "error (m)", "predictor", "hollow: a flight failed"):
        assert f">{text}</text>" in svg


def test_a_figure_is_three_files_whose_text_is_text(tmp_path, call):
    folder = sweep(tmp_path / "s")
    out = call("sweep figure", folder, "--out", tmp_path / "one.png").out
    assert out.splitlines()[-1] == str(tmp_path / "one.svg")
    assert (tmp_path / "one.pdf").read_bytes().startswith(b"%PDF")
    assert (tmp_path / "one.png").read_bytes().startswith(b"\x89PNG")
    assert ">delay (ms)</text>" in (tmp_path / "one.svg").read_text()


def test_missing_flights_are_reported(tmp_path, call, drawn):
    """An unfinished sweep may give another result in the end."""
    folder = sweep(tmp_path / "s", rows=22)
    assert "s, of which 2 flights are not done, over" in of_sweep(folder, "none", "kalman").what
    assert "2 flights are not done." in call("sweep figure", folder).out


def test_values_of_an_axis_are_paired_over_the_others(tmp_path):
    found, _, what = of_sweep(sweep(tmp_path / "s"), "predictor=none", "kalman")
    assert what.startswith(f"predictor in {tmp_path / 's'}, over all values of delay_ms, gain; ")
    assert what.endswith("p is too small")
    assert len(found) == 12
    assert found[0].label == {"delay_ms": 20, "gain": "[1, 2]", "seed": 1}
    assert {a["numbers"]["iae_mean"] - b["numbers"]["iae_mean"] for _, a, b in found} == {0.5}
