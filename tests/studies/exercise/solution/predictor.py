"""Predictor: eqs. (2) and (3) of the paper."""

from cloudrc.plugin import Predictor, rotate_ahead


class StudentPredictor(Predictor):
    def predict(self, odometry, horizon):
        rate = odometry.angular_velocity_body
        motion = zip(odometry.position, odometry.velocity, strict=True)
        return odometry._replace(
            stamp_ns=odometry.stamp_ns + round(horizon * 1e9),
            position=tuple(p + v * horizon for p, v in motion),
            orientation_wxyz=rotate_ahead(odometry.orientation_wxyz, rate, horizon),
        )


def build() -> StudentPredictor:
    return StudentPredictor()
