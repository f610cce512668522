"""Predictor of a user: moves with the velocity; or one whose every tenth result is NaN."""

from cloudrc.cloud.predictors import Predictor
from cloudrc.messages import Odometry


class Straight(Predictor):
    def __init__(self, fails: bool) -> None:
        self.fails, self.count = fails, 0

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        self.count += 1
        x, y, z = (
            p + v * horizon for p, v in zip(odometry.position, odometry.velocity, strict=True)
        )
        if self.fails and self.count > 100 and self.count % 10 == 0:
            x = float("nan")
        stamp_ns = odometry.stamp_ns + round(horizon * 1e9)
        return odometry._replace(stamp_ns=stamp_ns, position=(x, y, z))


def build(fails: bool = False) -> Straight:
    return Straight(fails)
