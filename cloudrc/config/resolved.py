"""An experiment with nothing left to look up: what the ends, the link and the report are made from.

Names have become what they stand for: the mission is inline, the link's directions are spelled
out, plug-ins carry all their parameters, limits have their values. Written to a file it is still
an experiment file, and flies the same run again.
"""

from __future__ import annotations

from math import sqrt

from pydantic import Field, ValidationInfo, field_validator

from cloudrc.config.fields import CommandAge, Speed
from cloudrc.config.schema import Cloud, Direction, Experiment, Guard, Mission, PlugIn

COMMAND_AGE_MAX_MS = 250.0
"""Default where neither the experiment nor the profile says [ms].
Source: docs/reference/plant.md, "Command age"."""


def speed_cap(command_age_max_ms: float) -> float:
    """Give the speed [m/s] at which the robot still comes to rest in time.

    It flies on for `command_age_max_ms` [ms] and 0.2 s, then brakes at 3 m/s^2:
    v (T + 0.2) + v^2 / 6 = 8.7 m.
    Source: docs/reference/plant.md, "Speed cap".
    """
    blind = command_age_max_ms * 1e-3 + 0.2
    return round(3.0 * (sqrt(blind * blind + 8.7 / 1.5) - blind), 6)


class ResolvedGuard(Guard):
    """A guard whose limits are all known."""

    command_age_max_ms: CommandAge = Field(
        COMMAND_AGE_MAX_MS, description="A command whose basis is older is not flown [ms]"
    )
    speed_max_mps: Speed = Field(
        speed_cap(COMMAND_AGE_MAX_MS), description="Cap on the commanded speed [m/s]"
    )

    @field_validator("speed_max_mps")
    @classmethod
    def _can_be_stopped(cls, speed_max: float, info: ValidationInfo) -> float:
        age_max = info.data.get("command_age_max_ms", COMMAND_AGE_MAX_MS)
        if speed_max > speed_cap(age_max) + 1e-6:
            raise ValueError(
                f"at most {speed_cap(age_max):g} m/s can be stopped from in time while commands "
                f"may be {age_max:g} ms old; lower it, or guard.command_age_max_ms"
            )
        return speed_max


class ResolvedCloud(Cloud):
    """Plug-ins with all their parameters, those of the defaults too."""

    estimator: PlugIn
    predictor: PlugIn
    controller: PlugIn


class ResolvedExperiment(Experiment):
    """An experiment with nothing left to look up."""

    mission: Mission
    guard: ResolvedGuard
    cloud: ResolvedCloud

    @property
    def uplink(self) -> Direction:
        """World to cloud, complete."""
        return self.link.uplink

    @property
    def downlink(self) -> Direction:
        """Cloud to world, complete."""
        return self.link.downlink
