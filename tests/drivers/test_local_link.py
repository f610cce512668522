"""A change of a local run's link acts within a second and is recorded and drawn."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest
from numpy.typing import NDArray

from cloudrc.record.columns import Recording

pytestmark = pytest.mark.process
WITHIN = 0.005
"""Tolerance of a median one-way delay beside other tests [s]."""
LEGS = (0.5, 8.9), (9.2, 9.95), (10.2, 12.0)
"""Intervals of the profile `handover`: before the fading, during it, and in the next cell [s]."""
EDGE = 0.01
"""Uncertainty of the start of a time line, which is the next datagram [s]."""
Floats: TypeAlias = NDArray[np.float64]


def test_link_set_acts_within_a_second_and_is_in_the_recording(
    tmp_path: Path, figure: Callable[..., None]
) -> None:
    folder = tmp_path / "run"
    command = [sys.executable, "-m", "cloudrc"]
    fly = [*command, "run", "hover", "--mode", "local", "--out", str(folder), "--set"]
    run = subprocess.Popen(
        [*fly, "mission.waypoints.0.dwell_s=18"], stdout=subprocess.PIPE, text=True
    )
    assert run.stdout is not None
    said = next(line for line in run.stdout if "mission started" in line)
    assert said
    done = [
        subprocess.run(
            [*command, "link", "set", *words, "--run", str(folder), "-o", "json"],
            check=True,
            capture_output=True,
            text=True,
        )
        for words in (["downlink.delay_ms=120", "downlink.jitter_ms=0"], ["--profile", "handover"])
        if not time.sleep(2.0)
    ]
    output, _ = run.communicate(timeout=60)
    assert run.returncode in (0, 6)
    assert "link: downlink 120 ms (downlink.delay_ms=120, downlink.jitter_ms=0)" in output
    assert not (folder / "link").exists()
    documents = [json.loads(one.stdout) for one in done]
    took = [document["seconds"] for document in documents]
    figure("link set, local: in force after", min(took), "<=", 1.0, "s")
    assert min(took) <= 1.0
    assert max(took) < 2.0, "on a busy machine"

    numbers = json.loads((folder / "report.json").read_text())["numbers"]
    for way in ("uplink", "downlink"):
        late = {name: numbers[f"release_error_{name}_{way}"] for name in ("p50", "p99", "p999")}
        print(way, {name: f"{1e6 * one['value']:.0f} us" for name, one in late.items()})
        assert 0.0 < late["p50"]["value"] <= late["p99"]["value"] <= late["p999"]["value"]
        assert late["p50"]["value"] < WITHIN
        assert numbers[f"released_early_{way}"] == {"value": 0.0, "unit": "1"}
        assert numbers[f"relay_overflow_{way}"]["value"] == 0.0

    recording = Recording.read(folder / "mission.mcap")
    link, arrivals = recording["/link"], recording["/downlink_delay"]
    told = {cause: stamp - age * 1e9 for cause, stamp, age, uplink in
            zip(link["cause"], link["stamp_ns"], link["age"], link["uplink"], strict=True)
            if not uplink}  # fmt: skip
    first, second = told["downlink.delay_ms=120, downlink.jitter_ms=0"], told["profile handover"]
    delays = arrivals["delay"]
    sent_ns = arrivals["stamp_ns"] - delays * 1e9
    assert np.median(delays[sent_ns < first]) == pytest.approx(0.045, abs=WITHIN)
    between = (sent_ns > first + 1e8) & (sent_ns < second)
    assert np.median(delays[between]) == pytest.approx(0.120, abs=WITHIN)
    follows_handover((sent_ns - second) * 1e-9, delays)
    page = (folder / "report.html").read_text()
    assert "Triangles: the link was set in flight (1: downlink.delay_ms=120" in page


def follows_handover(sent: Floats, delays: Floats) -> None:
    """Check that delays [s] follow the time line from the change of the profile on."""

    def median(begin: float, end: float) -> float:
        return float(np.median(delays[(sent > begin) & (sent < end)]))

    print({f"{a:g}-{b:g} s": round(1e3 * median(a, b), 1) for a, b in LEGS})
    steady, fading, after = (median(*leg) for leg in LEGS)
    assert steady == pytest.approx(0.025, abs=WITHIN)
    assert 0.045 < fading < 0.080, "50 ms, and more to keep the order"
    assert after == pytest.approx(0.035, abs=WITHIN)
    dark = (sent > 10.0 + EDGE) & (sent < 10.05 - EDGE)
    assert not dark.any(), "what was sent while the robot was handed over never arrives"
