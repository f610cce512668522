# SPDX-License-Identifier: Apache-2.0

"""All that a file of yours imports: base classes of plug-ins, what they get and return.

`docs/plugins.md` says which kind of plug-in needs which names. Errors are in `cloudrc` itself.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from cloudrc.cloud.controllers import Controller, ControlOutput, Goals, Planned
    from cloudrc.cloud.estimators import DelaySample, Estimator
    from cloudrc.cloud.perceptions import Frame, Perception, Scan, place_of, point_at, yaw_of
    from cloudrc.cloud.predictors import Model, Predictor, rotate_ahead
    from cloudrc.config.robot import RobotFacts
    from cloudrc.gym.executors import Chunk, Committed, Executor
    from cloudrc.gym.executors.newest import Newest
    from cloudrc.gym.executors.time_indexed import TimeIndexed
    from cloudrc.results.metrics.flight import Flight
    from cloudrc.results.record.columns import Recording
    from cloudrc.wire.messages import ZERO, Command, Odometry, Setpoint, Vector

_HOMES = {
    **dict.fromkeys(
        ("Controller", "ControlOutput", "Goals", "Planned"), "cloudrc.cloud.controllers"
    ),
    **dict.fromkeys(("DelaySample", "Estimator"), "cloudrc.cloud.estimators"),
    **dict.fromkeys(
        ("Frame", "Perception", "Scan", "place_of", "point_at", "yaw_of"),
        "cloudrc.cloud.perceptions",
    ),
    **dict.fromkeys(("Model", "Predictor", "rotate_ahead"), "cloudrc.cloud.predictors"),
    "RobotFacts": "cloudrc.config.robot",
    **dict.fromkeys(("Chunk", "Committed", "Executor"), "cloudrc.gym.executors"),
    "Newest": "cloudrc.gym.executors.newest",
    "TimeIndexed": "cloudrc.gym.executors.time_indexed",
    "Flight": "cloudrc.results.metrics.flight",
    "Recording": "cloudrc.results.record.columns",
    **dict.fromkeys(("ZERO", "Command", "Odometry", "Setpoint", "Vector"), "cloudrc.wire.messages"),
}
"""Public name -> the module that defines it."""

__all__ = [
    "ZERO",
    "Chunk",
    "Command",
    "Committed",
    "ControlOutput",
    "Controller",
    "DelaySample",
    "Estimator",
    "Executor",
    "Flight",
    "Frame",
    "Goals",
    "Model",
    "Newest",
    "Odometry",
    "Perception",
    "Planned",
    "Predictor",
    "Recording",
    "RobotFacts",
    "Scan",
    "Setpoint",
    "TimeIndexed",
    "Vector",
    "place_of",
    "point_at",
    "rotate_ahead",
    "yaw_of",
]


def __getattr__(name: str) -> Any:
    # Lazily: the file of a predictor needs neither gymnasium nor the reader of recordings.
    if name in _HOMES:
        from importlib import import_module

        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'cloudrc.plugin' has no attribute {name!r}")
