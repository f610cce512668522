"""Estimator of a user: the last loop delay; or one that raises after a while."""

from cloudrc.cloud.estimators import DelaySample, Estimator


class Last(Estimator):
    def __init__(self, fails: bool) -> None:
        self.fails, self.delay, self.count = fails, 0.0, 0

    def update(self, sample: DelaySample) -> None:
        self.delay, self.count = sample.loop_delay, self.count + 1

    def horizon(self, age: float) -> float:
        if self.fails and self.count > 200:
            raise RuntimeError("the estimator of the net")
        return self.delay


def build(fails: bool = False) -> Last:
    return Last(fails)
