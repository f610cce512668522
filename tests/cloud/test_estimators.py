"""Delay estimators by hand-worked numbers, in seconds."""

import pytest

from cloudrc.cloud.estimators import DelaySample, ewma, running_mean, running_mean_500, split


def loop_delay(seconds):
    """Make a sample whose other delays would give another result if they were used."""
    return DelaySample(loop_delay=seconds, rtt=seconds - 0.006, applied_minus_stamp=-777.0)


def feed(estimator, seconds, times=1):
    for _ in range(times):
        estimator.update(loop_delay(seconds))


def test_running_mean_is_equation_1():
    estimator = running_mean.build()
    horizons = []
    for seconds in (0.040, 0.060, 0.080, 0.020):
        feed(estimator, seconds)
        horizons.append(estimator.horizon(0.0))
    # 40 / 1; + (60 - 40) / 2; + (80 - 50) / 3; + (20 - 60) / 4
    assert horizons == pytest.approx([0.040, 0.050, 0.060, 0.050])


def test_running_mean_hardly_notices_a_step_after_a_long_time():
    estimator = running_mean.build()
    feed(estimator, 0.020, 1000)
    feed(estimator, 0.070, 100)
    assert estimator.horizon(0.0) == pytest.approx((1000 * 0.020 + 100 * 0.070) / 1100)


def test_running_mean_500_is_a_mean_for_the_first_500_samples():
    estimator, reference = running_mean_500.build(), running_mean.build()
    for k in range(500):
        feed(estimator, 0.020 + k * 1e-4)
        feed(reference, 0.020 + k * 1e-4)
        assert estimator.horizon(0.0) == reference.horizon(0.0)


def test_running_mean_500_then_keeps_a_gain_of_1_in_500():
    estimator = running_mean_500.build()
    feed(estimator, 0.020, 1000)
    feed(estimator, 0.070, 100)
    # 70 - 50 (499/500)^100 = 29.07 ms
    assert estimator.horizon(0.0) == pytest.approx(0.029072, abs=1e-6)


def test_running_mean_500_takes_another_count():
    estimator = running_mean_500.build(count_max=2)
    for seconds in (0.040, 0.060, 0.080):
        feed(estimator, seconds)
    assert estimator.horizon(0.0) == pytest.approx(0.065)  # 50 + (80 - 50) / 2


def test_ewma_starts_at_the_first_sample_and_moves_by_the_gain():
    estimator = ewma.build()
    feed(estimator, 0.040)
    assert estimator.horizon(0.0) == pytest.approx(0.040)
    feed(estimator, 0.060)
    assert estimator.horizon(0.0) == pytest.approx(0.041)


def test_ewma_tracks_half_a_step_within_fourteen_samples():
    estimator = ewma.build()
    feed(estimator, 0.020, 1000)
    feed(estimator, 0.070, 13)
    assert estimator.horizon(0.0) < 0.045
    feed(estimator, 0.070)
    assert estimator.horizon(0.0) > 0.045


@pytest.mark.parametrize("offset", [0.0, 1.234, -86_400.0])
def test_split_adds_the_age_and_cancels_the_clock_offset(offset):
    estimator = split.build()
    uplink, downlink = 0.030, 0.050
    estimator.update(DelaySample(9.0, 9.0, applied_minus_stamp=downlink - offset))
    assert estimator.horizon(uplink + offset) == pytest.approx(0.080, abs=1e-9)
    # The age of a slow packet counts at once, without averaging.
    assert estimator.horizon(0.090 + offset) == pytest.approx(0.140, abs=1e-9)


def test_split_averages_the_downlink():
    estimator = split.build(gain=0.25)
    estimator.update(DelaySample(9.0, 9.0, applied_minus_stamp=0.040))
    estimator.update(DelaySample(9.0, 9.0, applied_minus_stamp=0.080))
    assert estimator.horizon(0.010) == pytest.approx(0.060)  # 10 + 40 + (80 - 40) / 4


def test_split_is_never_negative_when_the_clock_of_world_jumps():
    estimator = split.build()
    estimator.update(DelaySample(9.0, 9.0, applied_minus_stamp=0.050))
    assert estimator.horizon(-5.0) == 0.0


@pytest.mark.parametrize("gain", [0, -0.1, 1.5, float("nan"), float("inf"), "fast", True])
@pytest.mark.parametrize("build", [ewma.build, split.build])
def test_a_gain_outside_0_to_1_is_refused(build, gain):
    with pytest.raises(ValueError, match=r"^gain: .*(above 0|at most 1|finite|not a number)"):
        build(gain=gain)


@pytest.mark.parametrize("count_max", [0, -3, 2.5, float("nan")])
def test_an_invalid_count_is_refused(count_max):
    with pytest.raises(ValueError, match=r"^count_max: "):
        running_mean_500.build(count_max=count_max)
