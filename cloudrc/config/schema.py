"""The experiment file as frozen objects: every key, its unit, range and default.

Keys carry their unit (`delay_ms`); `cloudrc/assembly.py` converts them to SI once. Unknown keys
are refused. Defaults are the paper's scheme with the published gains. An `Experiment` is what a
file may say; `config.resolved.ResolvedExperiment` is what is flown.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, Tag

from cloudrc.config.fields import (
    Acceleration,
    CommandAge,
    Finite,
    Limit,
    NotNegative,
    Patience,
    Positive,
    Section,
    Speed,
    Stay,
    YawRate,
)
from cloudrc.config.network import (
    Blackout,
    Change,
    Direction,
    GilbertElliott,
    Profile,
)

__all__ = [
    "Blackout",
    "Change",
    "Cloud",
    "Criteria",
    "Direction",
    "Experiment",
    "GilbertElliott",
    "Guard",
    "Link",
    "LowLevel",
    "Mission",
    "PlugIn",
    "Profile",
    "Report",
    "Sensors",
    "Steps",
    "Tunnel",
    "Waypoint",
    "World",
]

MAX_WAYPOINTS = 10_000


def _form(value: Any) -> str:
    """Tell a name from what it stands for."""
    return "<name>" if isinstance(value, str) else "<inline>"


class Waypoint(Section):
    """A point to fly to."""

    position_m: tuple[Finite, Finite, Finite] = Field(description="Base position [m], world frame")
    yaw_deg: Finite = Field(0.0, description="Heading [deg]")
    tolerance_m: Positive = Field(0.10, description="Distance that counts as there [m]")
    dwell_s: Stay = Field(0.5, description="How long to stay within the tolerance [s]")
    time_limit_s: Limit | None = Field(
        None,
        description="Time allowed for this leg, in which the robot is seen to fly on commands [s]; "
        "default: 3 times what it is expected to take",
    )


class Steps(Section):
    """Seeded random setpoints, one after the other: for judging predictors."""

    count: Annotated[int, Field(ge=1, le=1000)] = Field(10, description="Number of steps")
    period_s: Limit = Field(4.0, description="Time between two steps [s]")
    centre_m: tuple[Finite, Finite, Finite] = Field((0.0, 0.0, 1.2), description="Centre [m]")
    range_m: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (1.0, 1.0, 0.7), description="Largest distance from the centre per axis [m]"
    )


class Mission(Section):
    """What to fly: waypoints, or random steps."""

    description: str = Field("", description="One line for lists")
    start: Literal["spawn", "here"] = Field("spawn", description="Where the mission starts")
    waypoints: tuple[Waypoint, ...] = Field(
        (), max_length=MAX_WAYPOINTS, description="Points, in order"
    )
    steps: Steps | None = Field(None, description="Random steps in place of waypoints")


class LowLevel(Section):
    """Onboard velocity and attitude loops: the published gains at the true dt."""

    gain_p: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (4.0, 4.0, 10.0), description="Per axis [N/(m/s)]"
    )
    gain_i: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (1.0, 1.0, 2.5), description="Per axis [N/m]"
    )
    gain_d: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (0.30, 0.30, 0.50), description="Per axis [N/(m/s^2)]"
    )
    integral_limit_xy: NotNegative = Field(
        0.10, description="Limit of the integrated velocity error in x and y [m]"
    )
    integral_limit_z: NotNegative = Field(0.40, description="Likewise in z [m]")


class Sensors(Section):
    """Noise on the odometry that goes to the cloud; the onboard loop sees none."""

    position_noise_m: NotNegative = Field(0.0, description="Standard deviation per axis [m]")
    velocity_noise_mps: NotNegative = Field(0.0, description="Standard deviation per axis [m/s]")


class World(Section):
    """The robot and where it flies."""

    robot: str = Field("pelican", description="File name under world/robots, without .xml")
    scene: str = Field("pipes", description="File name under world/scenes, without .xml")
    low_level: LowLevel = LowLevel()
    sensors: Sensors = Sensors()


class Guard(Section):
    """What the onboard guard allows; configured on world's side only."""

    command_age_max_ms: CommandAge | None = Field(
        None,
        description="A command whose basis is older is not flown [ms]; "
        "default: the link profile's own, else 250",
    )
    speed_max_mps: Speed | None = Field(
        None,
        description="Cap on the commanded speed [m/s]; default: what can be stopped from within "
        "8.7 m although commands may be that old, 6 at 250 ms",
    )
    acceleration_max_mps2: Acceleration = Field(12.0, description="Cap on its change [m/s^2]")
    yaw_rate_max_radps: YawRate = Field(1.0, description="Cap on the yaw rate [rad/s]")
    hold_max_s: Patience = Field(
        60.0,
        description="HOLD for so long during a mission ends in LAND, and so does GROUND without a "
        "fresh command, after 10 s at least [s]; below 1 s less guard.command_age_max_ms any "
        "silence in flight does: it takes so long to fly on",
    )


class Tunnel(Section):
    """How the two ends treat late datagrams."""

    order: Literal["newest", "arrival"] = Field(
        "newest", description="newest: a late one is dropped; arrival: the last to arrive wins"
    )


class Link(Section):
    """The emulated network: a profile, and single values over it."""

    profile: str = Field("paper-p2", description="File name under link/profiles, or a path")
    uplink: Direction = Field(
        Direction(), description="World to cloud; what is named here overrides the profile"
    )
    downlink: Direction = Field(Direction(), description="Cloud to world; likewise")


class PlugIn(Section):
    """A plug-in by name, with its parameters beside it."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)
    name: str = Field(description="A file's name in the plug-in's folder, or a path")


PlugInChoice = Annotated[
    Annotated[str, Tag("<name>")] | Annotated[PlugIn, Tag("<inline>")], Discriminator(_form)
]


class Cloud(Section):
    """The remote controller."""

    estimator: PlugInChoice = Field("running_mean", description="Of the delay")
    predictor: PlugInChoice = Field("constant_velocity", description="Moves odometry ahead")
    controller: PlugInChoice = Field("pid", description="Tracks the setpoint")


class Criteria(Section):
    """What makes a flight a success."""

    contact: bool = Field(True, description="The tip has to touch the board")
    contact_speed_max_mps: Positive = Field(0.25, description="Tip speed allowed there [m/s]")
    time_limit_s: Limit = Field(60.0, description="Since the mission began [s]")


class Report(Section):
    """What the report of a run has beside the shipped and the installed metrics."""

    metrics: tuple[str, ...] = Field(
        (),
        description="Your own metrics, measured by `cloudrc run`: paths of Python files, or names "
        "that have to be installed",
    )


class Experiment(Section):
    """One experiment file."""

    # No slash: runs are kept in folders of this name.
    name: Annotated[str, Field(pattern=r"^[^/\\\x00]*$")] = Field(
        "", description="Label in reports, without slashes; default: the file's name"
    )
    description: str = Field("", description="One line for lists and reports")
    seed: Annotated[int, Field(ge=0, lt=2**53)] = Field(1, description="Of everything random")
    mission: Annotated[
        Annotated[str, Tag("<name>")] | Annotated[Mission, Tag("<inline>")], Discriminator(_form)
    ] = Field("pipes", description="A shipped mission, a file, or inline")
    world: World = World()
    guard: Guard = Guard()
    tunnel: Tunnel = Tunnel()
    link: Link = Link()
    cloud: Cloud = Cloud()
    criteria: Criteria = Criteria()
    report: Report = Report()
