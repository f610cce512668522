"""Delay estimator: eq. (1) of the paper."""

from cloudrc.plugin import Estimator


class DelayEstimator(Estimator):
    def __init__(self):
        self.mean, self.count = 0.0, 0

    def update(self, sample):
        self.mean += (sample.loop_delay - self.mean) / (self.count + 1)
        self.count += 1

    def horizon(self, age):
        return self.mean


def build() -> DelayEstimator:
    return DelayEstimator()
