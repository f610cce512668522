"""Losses, reordering, and errors of predictions and delay estimates.

They are computed by hand, by a full count, and from a flight's ground truth.
"""

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cloudrc.config.load import load_experiment
from cloudrc.exposition.live import LiveMetrics
from cloudrc.exposition.parts import WINDOW, DatagramTally, PredictionJudge
from cloudrc.records import CommandApplied, Control
from tests.console.conftest import control
from tests.flights.conftest import fly, numbers, records


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
    assert stream.expected == count
    assert stream.lost == count - len(sent)
    assert stream.reordered == late


def flying_along_x(predicted_lead, *, every_ms=10):
    """Yield a flight at 1 m/s along x, predicted 25 ms ahead with an error `predicted_lead` [m]."""
    for x in (at * 1e-3 for at in range(0, 400, every_ms)):
        predicted = (x + 0.025 + predicted_lead, 0.0, 0.0)
        yield control(7.0 + x, x, measured=(x, 0.0, 0.0), position=predicted, horizon=0.025)


@pytest.mark.parametrize(("lead", "every_ms", "judged"), [(0.01, 10, 37), (0, 10, 37), (1, 60, 0)])
def test_a_prediction_is_compared_at_its_own_instant(lead, every_ms, judged):
    """The last three wait for a measurement 25 ms later; none is compared across a gap."""
    judge = PredictionJudge()
    for period in flying_along_x(lead, every_ms=every_ms):
        judge.take(period)
    assert judge.judged == judged
    assert judge.square == pytest.approx(judged * lead**2, abs=1e-12)
    assert judge.error == pytest.approx((lead, 0, 0) if judged else (math.nan,) * 3, nan_ok=True)


def test_delay_errors_of_a_flight_match_its_ground_truth():
    experiment = load_experiment("hover", ["link.profile=paper-p2", "cloud.clock_offset_s=5"])
    world, cloud = records(experiment)
    controls = {(c.epoch, c.counter): c for c in cloud if isinstance(c, Control)}
    truth = set()
    for applied in (r for r in world if isinstance(r, CommandApplied)):
        passed_ns = applied.stamp_ns - applied.basis_stamp_ns
        horizon = controls[applied.epoch, applied.counter].horizon
        truth.add(round((horizon - passed_ns * 1e-9) * 1e6))
    live, seen = LiveMetrics("cloud"), set()
    for record in cloud:
        live.see([record])
        error = live.read().get("cloudrc_delay_estimate_error_seconds")
        if isinstance(record, Control) and error:
            seen.add(round(error[()] * 1e6))
    assert len(seen) > 100
    assert len(seen - truth) <= 0.01 * len(seen), "equal to 1 us, except for rounding"


def test_the_prediction_error_is_the_estimate_error_of_the_report():
    judge, chosen = PredictionJudge(), ("link.profile=paper-p3",)
    for record in records(load_experiment("steps", chosen))[1]:
        if isinstance(record, Control):
            judge.take(record)
    error = math.sqrt(judge.square / judge.judged)
    assert error == pytest.approx(numbers(fly("steps", *chosen))["estimate_error_rms"], rel=0.05)
