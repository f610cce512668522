"""The lateness of released datagrams: percentiles of few buckets, exact counts."""

from __future__ import annotations

import numpy as np
import pytest

from cloudrc.exposition.table import RELEASE_PERCENTILES
from cloudrc.link.relay import QUANTILES, Recent, ReleaseErrors

MS = 1_000_000


def observed(*errors_ns: int) -> ReleaseErrors:
    errors = ReleaseErrors()
    for error_ns in errors_ns:
        errors.observe(error_ns)
    return errors


@pytest.mark.parametrize("scale", [50.0, 20e3, 2e6, 200e6, 1e12])
def test_percentiles_are_those_of_the_sample_to_2_percent(scale: float) -> None:
    sample = np.random.default_rng(1).exponential(scale, 20_000).astype(int)
    errors = observed(*sample.tolist())
    assert len(errors._counts) < 2000, "memory is bounded"
    for (name, said), share in zip(
        list(errors.in_ns().items())[2:], (0.5, 0.99, 0.999), strict=True
    ):
        true = np.quantile(sample, share, method="inverted_cdf")
        assert true <= said <= 1.02 * true + 1.1, name


def test_nothing_is_said_before_the_first() -> None:
    assert ReleaseErrors().in_ns() == {}
    assert Recent().counts(ReleaseErrors()) == {"released_early": 0}


def test_the_report_gets_whole_numbers() -> None:
    told = observed(-1, 9_000, 9_000, 300_000).in_ns()
    assert (told["released"], told["released_early"]) == (4, 1)
    assert 9_000 <= told["release_error_p50_ns"] < 9_200
    assert 300_000 <= told["release_error_p99_ns"] == told["release_error_p999_ns"] < 306_000


def test_two_lanes_are_added_up() -> None:
    both = ReleaseErrors.together([observed(5_000), observed(400 * MS)])
    said = both.in_ns()
    assert (said["released"], said["release_error_p50_ns"] < 6_000) == (2, True)
    assert 400 * MS < said["release_error_p99_ns"] < 410 * MS


def test_recent_means_the_last_ten_calls() -> None:
    errors, recent, said = ReleaseErrors(), Recent(), []
    for second in range(14):
        errors = ReleaseErrors.together((errors, observed(9 * MS if second == 2 else 10_000)))
        said.append(recent.counts(errors)["release_error_p999_ns"])
    assert [late_ns > 8 * MS for late_ns in said] == [2 <= n < 12 for n in range(14)]


def test_metrics_and_relay_agree_on_percentiles() -> None:
    named = {name: float(label) / 100.0 for label, name in RELEASE_PERCENTILES.items()}
    assert named == pytest.approx(QUANTILES)
