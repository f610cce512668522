# SPDX-License-Identifier: Apache-2.0

"""Define the keys of a place where cloud may run, such as the files under places."""

from __future__ import annotations

from cloudrc.config.cloud import ComputeSpeed, Count, Sharing
from cloudrc.config.profile import DirectionConfig
from cloudrc.config.section import Section


class PlaceFile(Section):
    """A place where cloud may run."""

    description: str = ""
    """One line about the place, for lists"""
    profile: str = "ideal"
    """Link profile of the network to the place: a name, or a path"""
    uplink: DirectionConfig = DirectionConfig()
    """Conditions from the robot to the place; a key here overrides the profile"""
    downlink: DirectionConfig = DirectionConfig()
    """Conditions from the place to the robot; a key here overrides the profile"""
    speed: ComputeSpeed = 1.0
    """Speed of a core, as a multiple of that of the reference, for which cloud.compute_ms holds"""
    cores: Count | None = None
    """Number of cores that the clouds of all robots share. null: each has a core of its own"""
    sharing: Sharing = "fifo"
    """How they share the cores, see cloud.sharing"""
