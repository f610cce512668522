# SPDX-License-Identifier: Apache-2.0

"""The task on which a policy's answers disagree: executors keep the order of their publication."""

import pytest

from examples.fork import EXECUTORS, success
from tests.conftest import nightly


@pytest.mark.parametrize("delay", [4, *nightly(0, 2)])
@pytest.mark.parametrize("episodes", [10, *nightly(200)])
def test_real_time_chunking_passes_and_a_mean_of_both_sides_hits_the_pole(delay, episodes):
    rates = {name: success(each, delay, episodes) for name, each in EXECUTORS.items()}
    assert rates["rtc"] >= 0.95
    assert rates["rtc"] > max(rates["broker"], rates["async, weighted"])
    assert min(rates["broker"], rates["async, weighted"]) > rates["ensemble"]
