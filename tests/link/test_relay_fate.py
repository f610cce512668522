"""The same fate in every mode: a relay does to packet n what the virtual model draws for it.

Kernel stamps at both ends: how late Python is woken here changes nothing.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pytest

from cloudrc.config.shipped import names
from cloudrc.link.model import LinkDirection
from cloudrc.link.traces import write_trace
from cloudrc.tunnel.codec import Kind
from tests.link.conftest import SIZE
from tools.bench_link.flow import EPOCH, Flow, run_flow
from tools.bench_link.relays import fifo_allowed, ours
from tools.bench_link.stages import (
    SEED,
    Links,
    correlation,
    measure_profiles,
    profiles_of,
    random_walk,
)

pytestmark = pytest.mark.process
STEADY = ("lossy", "paper-p3")
"""Without queue, kept order or time line: the fate does not depend on the instant of sending."""
PATIENCE = 5e-3
"""With a busy machine [s]; what the relay can do is measured by `make bench-link`."""
AT_ONCE = 1e-3
"""Where the machine lets the relay run first [s]."""
TRIES = 3
"""Of a minute each: a machine that stands still for 0.1 s spoils the deviation of one [1]."""
SWAPPED = 0.01
"""Share of neighbours that may come the other way round, where something is taken in late [1]."""
LIVELY: dict[str, object] = {
    "profile": "ideal",
    "uplink": {"delay_ms": 20, "jitter_ms": 15, "duplicate": 0.2, "loss": 0.2, "reorder": 0.1},
}


def sound(folder: Path, link: dict[str, object], rate: float, seconds: float) -> list[Flow]:
    relay = ours(folder, link)
    flows = run_flow(relay.ways, rate, seconds, 0.5)
    relay.stop()
    return flows


@pytest.mark.promise("link-follows-the-seed")
@pytest.mark.parametrize("name", [*STEADY, "lively"])
def test_a_relay_run_draws_the_virtual_sequence(tmp_path: Path, name: str) -> None:
    """Asked of a model that never saw a clock: which numbers arrive, how often, how late."""
    link = LIVELY if name == "lively" else {"profile": name}
    flows = sound(tmp_path, link, 200.0, 1.5)
    for flow, profile in zip(flows, profiles_of(tmp_path, link), strict=True):
        virtual = LinkDirection(profile, SEED, flow.uplink)
        kind = Kind.TELEMETRY if flow.uplink else Kind.COMMAND
        drawn = {n: sorted(virtual.send(EPOCH, kind, n, SIZE, 0)) for n in range(len(flow.sent))}
        measured: dict[int, list[int]] = {n: [] for n in drawn}
        for at_ns, number in flow.arrived:
            measured[number].append(at_ns - flow.sent[number])
        assert {n: len(delays) for n, delays in measured.items()} == {
            n: len(delays) for n, delays in drawn.items()
        }
        errors = [
            late - delay
            for n in drawn
            for late, delay in zip(sorted(measured[n]), drawn[n], strict=True)
        ]
        assert min(errors) >= 0, "early"
        assert np.median(errors) < PATIENCE * 1e9


def check(folder: Path, links: Links, seconds: float, *, exact: bool) -> None:
    """What no machine may change holds in every try; how late it makes a relay, in one of them.

    The order is a machine's, too: what a relay that is held up takes in late may have been due
    before what has left.
    """
    worst = [_check(folder, links, seconds, exact=exact)]
    while exact and max(worst[-1]) > 1.0 and len(worst) < TRIES:
        worst.append(_check(folder, links, seconds, exact=exact))
    print("in units of what is allowed, worst mean and deviation, any out of order:", worst)
    assert not exact or min(max(one) for one in worst) <= 1.0


Worst: TypeAlias = tuple[float, float, float]


def _check(folder: Path, links: Links, seconds: float, *, exact: bool) -> Worst:
    """Sound them once; give the worst mean, deviation and order in units of what is allowed."""
    fifo = fifo_allowed()
    mean = deviation = order = 0.0
    for row in measure_profiles(folder, links, seconds, fifo=fifo):
        judged, where = row.judged, f"{row.name} {row.direction}"
        assert judged.wrongly_lost == judged.wrongly_arrived == 0, where
        assert judged.errors.min() >= 0.0, where
        assert np.median(judged.errors) < (AT_ONCE if fifo else PATIENCE), where
        assert judged.swapped <= SWAPPED * judged.errors.size, where
        if exact:
            order = max(order, math.inf if judged.swapped else 0.0)
            mean = max(mean, float(judged.errors.mean()) / 0.3e-3)
            deviation = max(deviation, float(judged.errors.std()) / 0.5e-3)
        if row.name == "trace":
            trace = profiles_of(folder, links["trace"])[0]
            assert correlation(judged, trace) >= 0.98, where
    return mean, deviation, order


def replay(folder: Path) -> dict[str, object]:
    (folder / "trace.csv").write_text(write_trace(random_walk(60.0)))
    trace = {"trace": str(folder / "trace.csv")}
    return {"profile": "ideal", "uplink": trace, "downlink": trace}


def test_a_slice_of_profiles_with_queue_and_kept_order(tmp_path: Path) -> None:
    """`lte` has a rate and keeps order, `satellite` and `wifi` lose in bursts, too."""
    links: Links = {name: {"profile": name} for name in ("lte", "satellite", "wifi")}
    check(tmp_path, links, 2.0, exact=False)


@pytest.mark.full
def test_every_shipped_profile_for_a_minute(tmp_path: Path) -> None:
    links: Links = {name: {"profile": name} for name in names("profile")}
    check(tmp_path, links | {"trace": replay(tmp_path)}, 60.0, exact=True)
