# SPDX-License-Identifier: Apache-2.0

"""Define the keys of what the controllers do not know: another robot, wind, errors of sensors."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Discriminator, Field, Tag

from cloudrc.config.section import Section
from cloudrc.link.profile import NotNegative

Factor = Annotated[float, Field(ge=0.2, le=5)]


def _factor_tag(value: Any) -> str:
    return "<each>" if isinstance(value, list | tuple) else "<all>"


ActuatorFactor = Annotated[
    Annotated[Factor, Tag("<all>")]
    | Annotated[tuple[Factor, ...], Field(min_length=1), Tag("<each>")],
    Discriminator(_factor_tag),
]
Offset = Annotated[float, Field(ge=-1, le=1)]
WindSpeed = Annotated[float, Field(ge=-20, le=20)]
Bias = Annotated[float, Field(ge=-90, le=90)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]


class SensorsConfig(Section):
    """Errors that world adds to the true state to make the odometry for cloud."""

    position_noise_m: NotNegative = 0.0
    """Standard deviation of the position noise per axis [m]"""
    velocity_noise_mps: NotNegative = 0.0
    """Standard deviation of the velocity noise per axis [m/s]"""
    attitude_bias_deg: tuple[Bias, Bias, Bias] = (0.0, 0.0, 0.0)
    """Constant error of the orientation: a rotation about the body's x, y, z [deg]"""
    attitude_noise_deg: Annotated[float, Field(ge=0, le=90)] = 0.0
    """Standard deviation of the orientation noise per body axis [deg]"""
    rate_bias_radps: tuple[_Finite, _Finite, _Finite] = (0.0, 0.0, 0.0)
    """Constant error of the angular velocity about the body's x, y, z [rad/s]"""
    rate_noise_radps: NotNegative = 0.0
    """Standard deviation of the angular velocity noise per body axis [rad/s]"""


class Plant(Section):
    """How the true robot differs from its model."""

    mass_factor: Factor = 1.0
    """True mass of the robot, as a multiple of the model's mass"""
    inertia_factor: Factor = 1.0
    """True inertia of the robot about each axis, as a multiple of the model's inertia"""
    payload_kg: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Mass of a payload, a point that is fixed to the robot [kg]"""
    payload_offset_m: tuple[Offset, Offset, Offset] = (0.0, 0.0, -0.1)
    """Position of the payload in the body frame, from the origin of the base [m]"""
    actuator_factor: ActuatorFactor = 1.0
    """True force of the actuators as a multiple of the model's: a number for all, or a list with a
    number for each, in the order of the model"""


class WindConfig(Section):
    """Horizontal wind: a mean velocity and gusts."""

    velocity_mps: tuple[WindSpeed, WindSpeed] = (0.0, 0.0)
    """Mean velocity of the air in x and y, world frame [m/s]"""
    gust_mps: Annotated[float, Field(ge=0, le=10)] = 0.0
    """Standard deviation of the gusts in x and in y [m/s]"""
    gust_time_s: Annotated[float, Field(ge=0.01, le=100)] = 1.0
    """Time constant of the gusts: their correlation falls to 37 % after this time [s]"""

    @property
    def blows(self) -> bool:
        """Whether there is any wind."""
        return any(self.velocity_mps) or self.gust_mps > 0.0
