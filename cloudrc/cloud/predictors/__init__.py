"""Predictors: odometry that is old by `horizon` becomes a prediction; one file each.

A plug-in file has a `build(**parameters)` with annotated parameters that returns a `Predictor`.
"""

from __future__ import annotations

from cloudrc.messages import Command, Odometry


class Predictor:
    """Moves odometry ahead in time. Only `predict` has to be written."""

    def observe(self, odometry: Odometry) -> None:
        """Take note of a newly arrived odometry sample (called once each, stamps rising)."""

    def commanded(self, command: Command) -> None:
        """Take note of a command that has just been sent."""

    def reset(self) -> None:
        """Forget everything: a new session begins."""

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Move `odometry` ahead.

        Args:
            odometry: Newest sample delivered. Position [m], velocity [m/s], world frame.
            horizon: Time to look ahead [s], >= 0.

        Returns:
            A new sample; `stamp_ns` advanced by `horizon`.
        """
        raise NotImplementedError
