# SPDX-License-Identifier: Apache-2.0

"""Losses, reordering, and errors of predictions and delay estimates.

They are computed by hand, by a full count, and from a flight's ground truth. The same records give
the same value in live metrics and in the report.
"""

import math
import random
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.config.load import load_experiment
from cloudrc.results.exposition.live import LiveMetrics
from cloudrc.results.exposition.table import METRICS
from cloudrc.results.metrics.definitions import (
    QUANTITIES,
    WINDOW,
    DatagramTally,
    PredictionJudge,
    RecordQuantity,
)
from cloudrc.results.metrics.flight import STATISTICS, _values
from cloudrc.results.metrics.link import WINDOW_MAX, count_accepted, transit_ns
from cloudrc.results.metrics.measure import SHIPPED
from cloudrc.results.record.columns import Recording
from cloudrc.results.report.flown import flight_of
from cloudrc.wire.messages import UPRIGHT, ZERO, GuardState, Odometry
from cloudrc.wire.records import (
    Arrival,
    CommandApplied,
    Control,
    GroundTruth,
    GuardChange,
    Lateness,
    MissionEvent,
    TelemetrySent,
)
from tests.doors.console.conftest import control
from tests.flights.conftest import records
from tests.results.metrics.conftest import SECOND, Log, at, flown, measured
from tools.docs import panels


def taken(counters):
    stream = DatagramTally()
    for counter in counters:
        stream.take(1, counter)
    return stream


def test_what_has_left_the_window_is_lost_until_an_epoch_begins():
    stream = taken([0, 2, *range(3, WINDOW + 1)])  # only number 0 has left the window
    assert (stream.expected, stream.lost) == (1, 0)
    for counter in (WINDOW + 1, 1000 + WINDOW, *range(1001 + WINDOW, 1001 + 2 * WINDOW)):
        stream.take(1, counter)
    assert (stream.expected, stream.lost) == (1001 + WINDOW, 999)
    for counter in range(1000, 1000 + WINDOW):
        stream.take(2, counter)
    assert (stream.expected, stream.lost) == (1001 + WINDOW, 999), "an epoch has its own window"


@given(st.permutations(range(2, 40)), st.lists(st.integers(2, 39)))
def test_the_report_counts_what_its_receiver_accepts(order, repeated):
    order = [*order[:30], *repeated, *(WINDOW_MAX + n for n in range(38)), *order[30:]]
    newest, seen = 1, set()
    for number in order:
        if number > newest - WINDOW_MAX:
            seen.add(number)
        newest = max(newest, number)
    assert count_accepted(np.array(order), 2) == len(seen)


@given(seed=st.integers(0, 10_000), loss=st.floats(0, 0.9), jitter=st.integers(0, 60))
@settings(max_examples=40, deadline=None)
def test_counts_match_the_true_loss_and_reordering(seed, loss, jitter):
    rng, count = random.Random(seed), 400
    sent = [0] + [n for n in range(1, count) if rng.random() >= loss]
    sent[1:] = sorted(sent[1:], key=lambda n: n + rng.random() * jitter)
    stream = taken([*sent, *range(count, count + WINDOW)])
    newest, late = -1, 0
    for counter in sent:
        late += counter < newest
        newest = max(newest, counter)
    assert (stream.expected, stream.lost, stream.reordered) == (count, count - len(sent), late)


@pytest.mark.parametrize(("lead", "every_ms", "judged"), [(0.01, 10, 37), (1, 60, 0)])
def test_a_prediction_is_compared_at_its_own_instant(lead, every_ms, judged):
    """The robot flies at 1 m/s along x; predictions by 25 ms are wrong by `lead` [m].

    The last three wait for a measurement 25 ms later; none is compared across a gap.
    """
    judge = PredictionJudge()
    for x in (ms * 1e-3 for ms in range(0, 400, every_ms)):
        predicted = {"position": (x + 0.025 + lead, 0.0, 0.0), "horizon": 0.025}
        judge.take(control(7.0 + x, x, measured=(x, 0.0, 0.0), **predicted))
    assert judge.judged == judged
    assert judge.square == pytest.approx(judged * lead**2, abs=1e-12)
    assert judge.error == pytest.approx((lead, 0, 0) if judged else (math.nan,) * 3, nan_ok=True)


def test_one_row_is_a_number_a_live_metric_and_a_panel():
    row = RecordQuantity(
        Control,
        lambda row: row.horizon,
        "s",
        "horizon_p95",
        "p95",
        "Horizon: 95th percentile.",
        label="horizon",
        live="cloudrc_horizon_seconds",
        now="Horizon.",
        panel="Horizon",
        chart=("Horizon [ms]", 1e3, 10),
    )
    flight = flown().flight()
    assert STATISTICS[row.statistic](_values(row, flight)) == 0.08
    (panel,) = yaml.safe_load(panels([row, replace(row, panel="")]))
    assert panel["queries"] == {"value": "cloudrc_horizon_seconds{$pods}"}
    names = {each.live.partition("[")[0] for each in QUANTITIES} - {""}
    assert names <= METRICS.keys()
    assert {each.name for each in QUANTITIES} - {""} <= SHIPPED.keys()


@cache
def of(name, *settings):
    """Fly; return the flight, and the records of world and of cloud."""
    experiment = load_experiment(name, settings)
    both = records(experiment)
    return flight_of(Recording.from_records(*both), experiment), *both


HOVER = "hover", "mission.waypoints.0.dwell_s=10"
LOSSY = (
    *(*HOVER, "seed=3"),
    *("link.both.loss=0.1", "link.both.delay_ms=30", "link.both.jitter_ms=20"),
)


def average(live, name):
    histogram = live.read()[name]
    return histogram.total / histogram.cumulative()[-1]


def seen_in(flight, cloud, kind):
    """Show live metrics all records of cloud but those of a class outside of the flight."""
    live, (first, last) = LiveMetrics("cloud"), flight.span_ns
    live.see(r for r in cloud if not isinstance(r, kind) or first <= r.stamp_ns <= last)
    return live


DELAYS = ("rtt", "loop_delay", "delay_sample")


@pytest.mark.parametrize(
    ("flown", "kind", "names"),
    [
        (("paper-verbatim", "link.profile=paper-p3"), Arrival, DELAYS),
        (LOSSY, Arrival, DELAYS),
        (LOSSY, Control, ("age_of_information",)),
    ],
)
def test_delays_and_the_age_of_information_are_equal_live_and_in_the_report(flown, kind, names):
    flight, _, cloud = of(*flown)
    live = seen_in(flight, cloud, kind)
    found = {name: average(live, f"cloudrc_{name}_seconds") for name in names}
    report = {name: measured(flight, f"{name}_mean") for name in names}
    assert found == pytest.approx(report, rel=1e-9)


def test_the_tracking_error_of_a_flight_is_equal_live_and_in_the_report():
    flight, _, cloud = of(*LOSSY)
    newest = flight.control["setpoint"][-1] - flight.control["measured"][-1]
    tracking = seen_in(flight, cloud, Control).read()["cloudrc_tracking_error_meters"]
    assert [tracking[axis,] for axis in "xyz"] == list(newest)


def test_the_loss_of_a_flight_is_equal_live_and_in_the_report():
    flight, world, cloud = of(*LOSSY)
    last_ns = flight.recording["/telemetry"]["stamp_ns"][-1]
    last_ns = min(flight.end_ns, last_ns - transit_ns(flight.recording, "uplink") - 1)
    stamps = {r.counter: r.stamp_ns for r in world if isinstance(r, TelemetrySent)}
    sent = [n for n, stamp_ns in stamps.items() if flight.start_ns <= stamp_ns <= last_ns]
    arrivals = [r for r in cloud if isinstance(r, Arrival) and r.counter in sent]
    live = LiveMetrics("cloud")
    live.see([*arrivals, arrivals[-1]._replace(counter=sent[-1] + WINDOW)])
    found = live.read()
    lost = found["cloudrc_datagrams_lost_total"]["uplink",]
    assert found["cloudrc_datagrams_expected_total"]["uplink",] == len(sent)
    assert lost / len(sent) == measured(flight, "loss_uplink") > 0.05


def test_the_error_of_an_estimate_is_equal_live_and_in_the_report():
    """For the report, what cloud measured stands for the truth."""
    flight, _, cloud = of(*LOSSY)
    first, last = flight.span_ns
    periods = [r for r in cloud if isinstance(r, Control) and first <= r.stamp_ns <= last]
    log, live = Log(cloud=[*periods, MissionEvent(last, "done", 0, "")]), LiveMetrics("cloud")
    log.world.append(GuardChange(first, GuardState.TRACK, ""))
    for each in {r.basis_stamp_ns: r for r in periods}.values():
        known = Odometry(each.basis_stamp_ns, each.measured, UPRIGHT, ZERO, ZERO)
        log.world.append(GroundTruth(known.stamp_ns, known, ZERO))
    live.see(periods)
    found = live.read()
    square = found["cloudrc_estimate_error_square_meters_total"][()]
    count = found["cloudrc_predictions_judged_total"][()]
    assert count > 0.9 * len(periods)
    error = measured(log.flight(), "estimate_error_rms")
    assert math.sqrt(square / count) == pytest.approx(error, rel=1e-9)


def test_the_real_time_factor_of_ten_seconds_is_equal_live_and_in_the_report():
    log = flown()
    wakes = [Lateness(at(n), "world", 1e-3, 1e-4, n * n * SECOND // 300) for n in range(11)]
    log.world += wakes
    live = LiveMetrics("world")
    live.see(wakes)
    factor = live.read()["cloudrc_real_time_factor"][()]
    assert factor == measured(log.flight(), "real_time_factor") < 0.98


HELD = [
    GuardChange(at(2.0), GuardState.HOLD, "command age"),
    GuardChange(at(3.5), GuardState.TRACK, "fresh commands again"),
    GuardChange(at(4.01), GuardState.HOLD, "new session"),
    GuardChange(at(6.02), GuardState.LAND, "held too long without the cloud"),
    GuardChange(at(7.0), GuardState.HOLD, "acknowledged before touch-down"),
]


@pytest.mark.parametrize("first", [0, 2, 5])
def test_the_holds_of_a_flight_are_equal_live_and_in_the_report(first):
    """A HOLD after LAND, or after the mission, interrupts no mission."""
    log, live = flown(), LiveMetrics("world")
    log.world += HELD[first:]
    live.see(log.ends()[0])
    found = live.read()
    assert found["cloudrc_guard_holds_total"][()] == measured(log.flight(), "hold_count")
    held = found["cloudrc_guard_held_seconds_total"][()]
    assert held == measured(log.flight(), "hold_time")
    assert held == pytest.approx({0: 3.51, 2: 2.01}.get(first, 0.0))


def test_delay_errors_of_a_flight_match_its_ground_truth():
    _, world, cloud = of(*HOVER, "link.profile=paper-p2", "cloud.clock_offset_s=5")
    horizons = {r.counter: r.horizon for r in cloud if isinstance(r, Control)}
    applied = [r for r in world if isinstance(r, CommandApplied)]
    truth = {horizons[r.counter] - (r.stamp_ns - r.basis_stamp_ns) * 1e-9 for r in applied}
    live, seen = LiveMetrics("cloud"), set()
    for record in cloud:
        live.see([record])
        if isinstance(record, Control):
            seen |= {*live.read().get("cloudrc_delay_estimate_error_seconds", {}).values()}
    assert len(seen) > 100
    assert seen <= truth
