"""The experiment file as frozen objects: every key, its unit, range and default.

Keys carry their unit (`delay_ms`); `cloudrc/assembly.py` converts them to SI once. Unknown keys
are refused. Defaults are the paper's scheme with the published gains. An `Experiment` is what a
file may say; `config.resolved.ResolvedExperiment` is what is flown.

What every section of a configuration file is made of: closed models and ranged numbers.

The network's part of the configuration: a profile and its two directions as frozen objects.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    Tag,
    field_validator,
    model_validator,
)

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


class GilbertElliott(Section):
    """Loss in bursts: a two-state Markov chain that advances with every packet."""

    bad_start: Share = Field(description="Chance per packet to go from the good to the bad state")
    bad_end: Share = Field(description="Chance per packet to go from the bad to the good state")
    loss_bad: Share = Field(1.0, description="Loss in the bad state")
    loss_good: Share = Field(0.0, description="Loss in the good state")
    delay_bad_ms: NotNegative = Field(0.0, description="Extra delay in the bad state, one way [ms]")

    @model_validator(mode="after")
    def _ends(self) -> GilbertElliott:
        if self.bad_start > 0 and self.bad_end == 0:
            raise ValueError("bad_end must be above 0 where bad_start is: the burst never ends")
        return self


def _kind_of_loss(value: Any) -> str:
    return "<bursts>" if isinstance(value, dict | GilbertElliott) else "<chance>"


Loss = Annotated[
    Annotated[Share, Tag("<chance>")] | Annotated[GilbertElliott, Tag("<bursts>")],
    Discriminator(_kind_of_loss),
]


class Blackout(Section):
    """A time in which nothing passes."""

    start_s: NotNegative = Field(description="Since the link came up [s]")
    duration_s: Positive = Field(description="How long [s]")


class Change(Section):
    """From `at_s` on these values hold; those not named stay as they are."""

    at_s: NotNegative = Field(description="Since the link came up [s]")
    delay_ms: NotNegative | None = Field(None, description="One way [ms]")
    jitter_ms: NotNegative | None = Field(None, description="As in the direction [ms]")
    loss: Loss | None = Field(None, description="Chance, or bursts")
    rate_kbit: Positive | None = Field(None, description="Rate of the bottleneck [kbit/s]")


class Direction(Section):
    """Network conditions of one direction. All delays are ONE WAY."""

    delay_ms: NotNegative = Field(0.0, description="One way [ms]")
    jitter_ms: NotNegative = Field(
        0.0, description="uniform: half width; normal, pareto, table: standard deviation [ms]"
    )
    distribution: Literal["uniform", "normal", "pareto", "table"] = Field(
        "uniform", description="Of the jitter; table: that of the delays in the file `table`"
    )
    table: str | None = Field(
        None, description="CSV file as for trace, whose delays, scaled, are the distribution"
    )
    correlation: Share = Field(0.0, description="Of the jitter of one packet with the next")
    loss: Loss = Field(0.0, description="Chance, or bursts")
    duplicate: Share = Field(0.0, description="Chance that a packet arrives twice")
    reorder: Share = Field(0.0, description="Chance that a packet overtakes: no delay at all")
    corrupt: Share = Field(0.0, description="Chance that one bit of a packet is flipped")
    keep_order: bool = Field(False, description="Packets never overtake each other")
    rate_kbit: Positive | None = Field(None, description="Rate of the bottleneck [kbit/s]")
    queue_packets: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        1000, description="Packets that wait at the bottleneck before the next is dropped"
    )
    changes: tuple[Change, ...] = Field((), description="Time line, rising in at_s")
    trace: str | None = Field(
        None, description="CSV file: time_s,delay_ms[,loss]; relative to the file that names it"
    )
    blackouts: tuple[Blackout, ...] = Field((), description="Times in which nothing passes")

    @model_validator(mode="after")
    def _has_its_table(self) -> Direction:
        if self.distribution == "table" and self.table is None:
            raise ValueError("distribution: table needs the key table: a CSV file of delays")
        return self

    @field_validator("changes")
    @classmethod
    def _rise(cls, changes: tuple[Change, ...]) -> tuple[Change, ...]:
        for index, (before, after) in enumerate(pairwise(changes), start=1):
            if after.at_s <= before.at_s:
                raise ValueError(
                    f"at_s must rise: entry {index} is at {after.at_s:g} s, "
                    f"the one before at {before.at_s:g} s"
                )
        return changes


class Profile(Section):
    """A file under link/profiles."""

    description: str = Field("", description="One line for lists")
    uplink: Direction = Field(Direction(), description="World to cloud")
    downlink: Direction = Field(Direction(), description="Cloud to world")
    command_age_max_ms: CommandAge | None = Field(
        None, description="Command age limit that this link needs [ms]"
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
