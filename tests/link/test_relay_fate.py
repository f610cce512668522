"""A relay does to packet n what the virtual model draws for it, by the kernel's stamps."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cloudrc.config.shipped import names
from cloudrc.link.model import LinkDirection
from cloudrc.tunnel.codec import Kind
from tests.link.conftest import SIZE
from tools.bench_link.flow import EPOCH, run_flow
from tools.bench_link.relays import fifo_allowed, ours
from tools.bench_link.stages import (
    SEED,
    Links,
    correlation,
    measure_profiles,
    profiles_of,
    replayed_trace,
)

pytestmark = pytest.mark.process
STEADY = ("lossy", "paper-p3")
"""Without queue, kept order or time line: the fate does not depend on the instant of sending."""
PATIENCE = 5e-3
"""Largest median error on a busy machine [s]; `make bench-link` measures what the relay can do."""
AT_ONCE = 1e-3
"""Likewise under SCHED_FIFO [s]."""
TRIES = 3
"""Tries of a minute each: a machine that stands still for 0.1 s spoils one."""
SWAPPED = 0.01
"""Share of neighbours in the wrong order where something is taken in late [1]."""
LIVELY: dict[str, object] = {
    "profile": "ideal",
    "uplink": {"delay_ms": 20, "jitter_ms": 15, "duplicate": 0.2, "loss": 0.2, "reorder": 0.1},
}


@pytest.mark.promise("link-follows-the-seed")
@pytest.mark.parametrize("name", [*STEADY, "lively"])
def test_a_relay_run_draws_the_virtual_sequence(tmp_path: Path, name: str) -> None:
    """Ask a model that never saw a clock: which numbers arrive, how often, how late."""
    link = LIVELY if name == "lively" else {"profile": name}
    relay = ours(tmp_path, link)
    flows = run_flow(relay.ways, 200.0, 1.5, 0.5)
    relay.stop()
    for flow, profile in zip(flows, profiles_of(tmp_path, link), strict=True):
        virtual = LinkDirection(profile, SEED, flow.uplink)
        kind = Kind.TELEMETRY if flow.uplink else Kind.COMMAND
        measured: dict[int, list[int]] = {n: [] for n in flow.sent}
        for at_ns, number in flow.arrived:
            measured[number].append(at_ns - flow.sent[number])
        errors = []
        for n, late in measured.items():
            drawn = sorted(virtual.send(EPOCH, kind, n, SIZE, 0))
            assert len(late) == len(drawn), n
            errors += [one - delay for one, delay in zip(sorted(late), drawn, strict=True)]
        assert min(errors) >= 0, "early"
        assert np.median(errors) < PATIENCE * 1e9


def worst(folder: Path, links: Links, seconds: float) -> tuple[float, float, float]:
    """Send through links; return the worst mean, deviation and order over what is allowed."""
    fifo = fifo_allowed()
    mean = deviation = order = 0.0
    for row in measure_profiles(folder, links, seconds, fifo=fifo):
        judged, where = row.judged, f"{row.name} {row.direction}"
        assert judged.wrongly_lost == judged.wrongly_arrived == 0, where
        assert judged.errors.min() >= 0.0, where
        assert np.median(judged.errors) < (AT_ONCE if fifo else PATIENCE), where
        assert judged.swapped <= SWAPPED * judged.errors.size, where
        if row.name == "trace":
            assert correlation(judged, profiles_of(folder, links["trace"])[0]) >= 0.98, where
        order = max(order, math.inf if judged.swapped else 0.0)
        mean = max(mean, float(judged.errors.mean()) / 0.3e-3)
        deviation = max(deviation, float(judged.errors.std()) / 0.5e-3)
    return mean, deviation, order


def test_profiles_with_queue_and_kept_order_are_as_drawn(tmp_path: Path) -> None:
    """`lte` has a rate and keeps order, `satellite` and `wifi` lose in bursts, too."""
    worst(tmp_path, {name: {"profile": name} for name in ("lte", "satellite", "wifi")}, 2.0)


@pytest.mark.full
def test_every_shipped_profile_for_a_minute(tmp_path: Path) -> None:
    links: Links = {name: {"profile": name} for name in names("profile")}
    links["trace"] = replayed_trace(tmp_path)
    found = []
    while not found or (max(found[-1]) > 1.0 and len(found) < TRIES):
        found.append(worst(tmp_path, links, 60.0))
    assert min(map(max, found)) <= 1.0, found
