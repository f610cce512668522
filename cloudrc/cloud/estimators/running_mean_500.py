# SPDX-License-Identifier: Apache-2.0

"""Delay estimator: a running mean of the loop delay whose gain stays at 1/500 after 500 samples.

Source: the authors' published code. Its comments describe a window of 500 samples, but the code
computes a mean with the gain 1/(k+1), which falls to 1/500 and then stays: from then on the mean is
an exponential average.
"""

from __future__ import annotations

from cloudrc.cloud.estimators.running_mean import RunningMean
from cloudrc.config.cloud import Count


def build(count_max: Count = 500) -> RunningMean:
    """Make the estimator that the paper's authors use in their published code.

    Args:
        count_max: Number of samples; after them, each new sample has the weight 1/count_max.
    """
    return RunningMean(count_max)
