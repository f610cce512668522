# SPDX-License-Identifier: Apache-2.0

"""The section `follow` of a mission: keep a moving body of the scene in the camera's picture."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from cloudrc.config.section import Section
from cloudrc.link.profile import NotNegative, Positive

Duration = Annotated[float, Field(gt=0, le=3600)]


class Follow(Section):
    """A moving body of the scene that the robot's camera has to keep in its picture."""

    target: Annotated[str, Field(min_length=1)]
    """Name of a body of the scene that moves: its file has the numbers TARGET_path and
    TARGET_speed"""
    height_m: Positive = 1.5
    """Height over the spawn to which the robot takes off [m]; there it stays until
    cloud.perception says where to go. A robot on the ground stays there"""
    duration_s: Duration = 40.0
    """Time from the mission's start after which its one waypoint counts as reached [s]"""
    lost_after_s: NotNegative = 2.0
    """Longest time at a stretch for which the target may be out of view [s]; after a longer one the
    mission fails, and the flight goes on"""
    distance_max_m: Positive = 6.0
    """Distance from the camera up to which the target is in view [m]"""
