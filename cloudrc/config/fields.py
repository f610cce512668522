"""What every section of a configuration file is made of: closed models and ranged numbers."""

from __future__ import annotations

from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
# A limit that limits nothing, or stops everything, is none: the guard's have bounds on both sides.
COMMAND_AGE_MS = 1, 10_000
"""Least and largest limit of a command's age [ms]."""
CommandAge = Annotated[
    float, Field(ge=COMMAND_AGE_MS[0], le=COMMAND_AGE_MS[1], allow_inf_nan=False)
]
Speed = Annotated[float, Field(ge=0.01, le=10, allow_inf_nan=False)]
Acceleration = Annotated[float, Field(ge=0.1, le=100, allow_inf_nan=False)]
YawRate = Annotated[float, Field(ge=0.01, le=10, allow_inf_nan=False)]
Patience = Annotated[float, Field(ge=0.1, le=3600, allow_inf_nan=False)]
DURATION_MAX = 1_000_000
"""Longest that a mission, a leg of it or a stay may be told to last [s]: eleven days."""
Stay = Annotated[float, Field(ge=0, le=DURATION_MAX, allow_inf_nan=False)]
Limit = Annotated[float, Field(gt=0, le=DURATION_MAX, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Section(BaseModel):
    """A part of a configuration file: frozen, closed, strictly typed."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)
