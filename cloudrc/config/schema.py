"""Define every key of experiments, missions and link profiles, with its unit, range and default.

The name of a key ends with its unit (`delay_ms`); `cloudrc/assembly.py` converts the values to SI
units. Unknown keys are refused. The defaults are the paper's scheme with the published gains.
`Experiment` is what a file may contain; `config.load.ResolvedExperiment` is what a run flies.
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
# The guard's limits have bounds on both sides: none of them can be switched off.
COMMAND_AGE_MS = 1, 10_000
"""Range of the age limit of commands: smallest and largest value [ms]."""
CommandAge = Annotated[
    float, Field(ge=COMMAND_AGE_MS[0], le=COMMAND_AGE_MS[1], allow_inf_nan=False)
]
Speed = Annotated[float, Field(ge=0.01, le=10, allow_inf_nan=False)]
Acceleration = Annotated[float, Field(ge=0.1, le=100, allow_inf_nan=False)]
YawRate = Annotated[float, Field(ge=0.01, le=10, allow_inf_nan=False)]
HoldTime = Annotated[float, Field(ge=0.1, le=3600, allow_inf_nan=False)]
DURATION_MAX = 1_000_000
"""Largest value for a time limit or a dwell in a mission [s]: eleven days."""
Dwell = Annotated[float, Field(ge=0, le=DURATION_MAX, allow_inf_nan=False)]
TimeLimit = Annotated[float, Field(gt=0, le=DURATION_MAX, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Section(BaseModel):
    """A section of a configuration file: immutable, without unknown keys, strictly typed."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class GilbertElliott(Section):
    """Loss in bursts: a two-state Markov chain that takes one step per packet."""

    bad_start: Probability = Field(
        description="Chance per packet that the good state turns bad, 0 to 1; 0: no burst begins"
    )
    bad_end: Probability = Field(
        description="Chance per packet that the bad state turns good, 0 to 1; a burst has "
        "1 / bad_end packets on average. Must be above 0 if bad_start is"
    )
    loss_bad: Probability = Field(
        1.0, description="Chance that a packet is lost in the bad state, 0 to 1; 1: all are lost"
    )
    loss_good: Probability = Field(
        0.0, description="Chance that a packet is lost in the good state, 0 to 1; 0: none is lost"
    )
    delay_bad_ms: NotNegative = Field(
        0.0, description="Extra one-way delay in the bad state [ms]; netem refuses a value above 0"
    )

    @model_validator(mode="after")
    def _ends(self) -> GilbertElliott:
        if self.bad_start > 0 and self.bad_end == 0:
            raise ValueError("bad_end must be above 0 if bad_start is: else a burst never ends")
        return self


def _loss_tag(value: Any) -> str:
    return "<bursts>" if isinstance(value, dict | GilbertElliott) else "<chance>"


Loss = Annotated[
    Annotated[Probability, Tag("<chance>")] | Annotated[GilbertElliott, Tag("<bursts>")],
    Discriminator(_loss_tag),
]


class Blackout(Section):
    """An interval in which every packet is lost."""

    start_s: NotNegative = Field(description="Start, in time since the link came up [s]")
    duration_s: Positive = Field(description="Length [s], above 0")


class Change(Section):
    """New conditions from `at_s` on; every key that is not given keeps its value."""

    at_s: NotNegative = Field(description="Start, in time since the link came up [s]")
    delay_ms: NotNegative | None = Field(
        None, description="New mean one-way delay [ms]; null: unchanged"
    )
    jitter_ms: NotNegative | None = Field(
        None, description="New jitter [ms], as in the direction; null: unchanged"
    )
    loss: Loss | None = Field(
        None, description="New loss, a chance from 0 to 1 or bursts; null: unchanged"
    )
    rate_kbit: Positive | None = Field(
        None, description="New rate of the bottleneck [kbit/s]; null: unchanged"
    )


class Direction(Section):
    """Network conditions of one direction. All delays are ONE WAY."""

    delay_ms: NotNegative = Field(
        0.0, description="Mean one-way delay [ms]; a round trip is the sum of both directions"
    )
    jitter_ms: NotNegative = Field(
        0.0,
        description="Spread of the delay [ms]; half width of uniform, standard deviation of the "
        "other distributions. A delay below 0 becomes 0, which raises the mean",
    )
    distribution: Literal["uniform", "normal", "pareto", "table"] = Field(
        "uniform",
        description="Distribution of the jitter; pareto has a long tail; table: that of the delays "
        "in the file `table`",
    )
    table: str | None = Field(
        None,
        description="CSV file as for `trace`; its delays, shifted to mean 0 and scaled to "
        "`jitter_ms`, are the distribution. Needed with distribution: table",
    )
    correlation: Probability = Field(
        0.0, description="Correlation of a packet's jitter with the next packet's, 0 to 1"
    )
    loss: Loss = Field(
        0.0, description="Loss: a chance per packet from 0 to 1, or a mapping for loss in bursts"
    )
    duplicate: Probability = Field(
        0.0, description="Chance that a packet arrives twice, 0 to 1; the copy has its own delay"
    )
    reorder: Probability = Field(
        0.0,
        description="Chance that a packet has no delay and overtakes others, 0 to 1; "
        "no effect with keep_order",
    )
    corrupt: Probability = Field(
        0.0,
        description="Chance that one bit of a packet is flipped, 0 to 1; the receiver refuses "
        "such a packet",
    )
    keep_order: bool = Field(
        False, description="Whether packets arrive in the order of sending, as from a queue"
    )
    rate_kbit: Positive | None = Field(
        None,
        description="Rate of the bottleneck [kbit/s], 28 bytes of headers included; null: none",
    )
    queue_packets: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        1000,
        description="Packets that the bottleneck holds, the one being sent included; further ones "
        "are dropped",
    )
    changes: tuple[Change, ...] = Field(
        (), description="Changes of the conditions over time; at_s must rise"
    )
    trace: str | None = Field(
        None,
        description="CSV file with the columns time_s,delay_ms[,loss]; it replaces delay_ms, and "
        "loss if it has that column. A relative path starts at the file that names it",
    )
    loop: bool = Field(
        False,
        description="Whether the trace begins again after its end; then changes and blackouts "
        "repeat with it. Not for netem",
    )
    blackouts: tuple[Blackout, ...] = Field(
        (), description="Intervals in which every packet is lost; they may overlap"
    )

    @model_validator(mode="after")
    def _check_table(self) -> Direction:
        if self.distribution == "table" and self.table is None:
            raise ValueError("distribution: table needs the key table: a CSV file of delays")
        return self

    @field_validator("changes")
    @classmethod
    def _check_times_rise(cls, changes: tuple[Change, ...]) -> tuple[Change, ...]:
        for index, (before, after) in enumerate(pairwise(changes), start=1):
            if after.at_s <= before.at_s:
                raise ValueError(
                    f"at_s must rise: entry {index} is at {after.at_s:g} s, "
                    f"the one before at {before.at_s:g} s"
                )
        return changes


class Profile(Section):
    """A link profile, such as the files under link/profiles."""

    description: str = Field("", description="One line about the profile, for lists")
    uplink: Direction = Field(Direction(), description="Conditions from world to cloud")
    downlink: Direction = Field(Direction(), description="Conditions from cloud to world")
    command_age_max_ms: CommandAge | None = Field(
        None,
        description="Default of guard.command_age_max_ms with this profile [ms]; null: 250",
    )


MAX_WAYPOINTS = 10_000
"""Largest number of waypoints in a mission."""


def _name_or_inline(value: Any) -> str:
    return "<name>" if isinstance(value, str) else "<inline>"


class Waypoint(Section):
    """A point to fly to."""

    position_m: tuple[Finite, Finite, Finite] = Field(
        description="Position of the base [m], world frame; must be where the guard lets the robot "
        "fly and clear of the pipes' walls, and so must the straight way there"
    )
    yaw_deg: Finite = Field(
        0.0, description="Heading [deg]; only 0 is accepted, the onboard controller holds yaw at 0"
    )
    tolerance_m: Positive = Field(
        0.10, description="Distance from the point at which it counts as reached [m]"
    )
    dwell_s: Dwell = Field(
        0.5, description="Time that the robot must stay within the tolerance [s]; 0: it flies on"
    )
    time_limit_s: TimeLimit | None = Field(
        None,
        description="Time limit for the leg to this point [s]; a HOLD does not count. Beyond it "
        "the mission fails. null: 3 times the expected time",
    )


class Steps(Section):
    """Random setpoints in sequence, drawn from the seed, to compare predictors."""

    count: Annotated[int, Field(ge=1, le=1000)] = Field(10, description="Number of setpoints")
    period_s: TimeLimit = Field(
        4.0, description="Time between two setpoints [s], whether or not the first was reached"
    )
    centre_m: tuple[Finite, Finite, Finite] = Field(
        (0.0, 0.0, 1.2), description="Centre of the box of setpoints [m], world frame"
    )
    range_m: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (1.0, 1.0, 0.7),
        description="Half the size of that box per axis [m]; it must be inside the fence and clear "
        "of the pipes' walls",
    )


class Mission(Section):
    """A mission: waypoints, or random steps."""

    description: str = Field("", description="One line about the mission, for lists")
    start: Literal["spawn", "here"] = Field(
        "spawn",
        description="Where the mission starts; spawn: the robot's place on the ground; here: where "
        "the robot is",
    )
    waypoints: tuple[Waypoint, ...] = Field(
        (), max_length=MAX_WAYPOINTS, description="Points to fly to in this order, at most 10000"
    )
    steps: Steps | None = Field(None, description="Random setpoints in place of waypoints")


class LowLevel(Section):
    """The onboard velocity loop: the published gains at the true time step."""

    gain_p: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (4.0, 4.0, 10.0),
        description="Proportional gain per axis [N/(m/s)]; 0 switches the term off",
    )
    gain_i: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (1.0, 1.0, 2.5), description="Integral gain per axis [N/m]; 0 switches the term off"
    )
    gain_d: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (0.30, 0.30, 0.50),
        description="Derivative gain per axis [N/(m/s^2)]; 0 switches the term off",
    )
    integral_limit_xy: NotNegative = Field(
        0.10,
        description="Limit on the integral of the velocity error in x and y [m]; it is clipped "
        "there",
    )
    integral_limit_z: NotNegative = Field(
        0.40,
        description="Limit on the integral of the velocity error in z [m]; it is clipped there",
    )


class Sensors(Section):
    """White noise on the odometry for cloud; the onboard controller sees the true state."""

    position_noise_m: NotNegative = Field(
        0.0, description="Standard deviation of the position noise per axis [m]; 0: none"
    )
    velocity_noise_mps: NotNegative = Field(
        0.0, description="Standard deviation of the velocity noise per axis [m/s]; 0: none"
    )


class World(Section):
    """The robot and its scene."""

    robot: str = Field(
        "pelican",
        description="Robot that ships with cloudrc, or a path of an MJCF file (.xml) for which the "
        "onboard controller is made: mass, inertia, rotors",
    )
    scene: str = Field(
        "pipes", description="Scene that ships with cloudrc, or a path of an MJCF file (.xml)"
    )
    low_level: LowLevel = LowLevel()
    sensors: Sensors = Sensors()


class Guard(Section):
    """Limits of the onboard guard; only world reads them."""

    command_age_max_ms: CommandAge | None = Field(
        None,
        description="Age limit of a command [ms], counted from the odometry that it is based on. "
        "The robot holds its position if its newest command is older. "
        "null: the link profile's value, else 250",
    )
    speed_max_mps: Speed | None = Field(
        None,
        description="Cap on the commanded speed [m/s]; a faster command is shortened. null: the "
        "largest speed from which the robot stops within 8.7 m despite commands of that age, "
        "6 at 250 ms; a larger value is refused",
    )
    acceleration_max_mps2: Acceleration = Field(
        12.0, description="Cap on the change of the reference velocity [m/s^2]"
    )
    yaw_rate_max_radps: YawRate = Field(
        1.0, description="Cap on the commanded yaw rate [rad/s]; a faster command is shortened"
    )
    hold_max_s: HoldTime = Field(
        60.0,
        description="Time in HOLD during a mission after which the robot lands [s]. On the ground "
        "the mission ends after the same time without a fresh command, at least 10 s. Below 1 s "
        "minus guard.command_age_max_ms, every silence in flight ends in LAND",
    )


class Tunnel(Section):
    """How both ends treat late datagrams."""

    order: Literal["newest", "arrival"] = Field(
        "newest",
        description="Which datagram counts; newest: the last sent, a late one is dropped; arrival: "
        "the last to arrive",
    )


class Link(Section):
    """The emulated network: a profile, and single values that override the profile's values."""

    profile: str = Field("paper-p2", description="Name of a shipped link profile, or a path")
    uplink: Direction = Field(
        Direction(), description="Conditions from world to cloud; a key here overrides the profile"
    )
    downlink: Direction = Field(
        Direction(), description="Conditions from cloud to world; a key here overrides the profile"
    )


class PlugIn(Section):
    """A plug-in by name, and its parameters as further keys."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)
    name: str = Field(
        description="Name of a plug-in that is shipped or installed, or a path of a Python file"
    )


PlugInChoice = Annotated[
    Annotated[str, Tag("<name>")] | Annotated[PlugIn, Tag("<inline>")],
    Discriminator(_name_or_inline),
]


class Cloud(Section):
    """The remote controller."""

    estimator: PlugInChoice = Field(
        "running_mean", description="Estimates the delays: a name, or a mapping with parameters"
    )
    predictor: PlugInChoice = Field(
        "constant_velocity",
        description="Predicts the odometry at the time at which a command takes effect: a name, "
        "or a mapping with parameters",
    )
    controller: PlugInChoice = Field(
        "pid", description="Tracks the setpoint: a name, or a mapping with parameters"
    )


class Criteria(Section):
    """What a flight needs to count as a success."""

    contact: bool = Field(True, description="Whether the tip of the arm must touch the board")
    contact_speed_max_mps: Positive = Field(
        0.25, description="Largest speed of the tip at that touch [m/s]; a faster one is a failure"
    )
    time_limit_s: TimeLimit = Field(
        60.0, description="Time limit of the mission [s], counted from its start; then it fails"
    )


class Report(Section):
    """Additions to the report of a run."""

    metrics: tuple[str, ...] = Field(
        (),
        description="Your own metrics for `cloudrc run`: paths of Python files; a name here "
        "must be installed, else the run is refused",
    )


class Experiment(Section):
    """An experiment file."""

    # No slash: a run's folder has this name.
    name: Annotated[str, Field(pattern=r"^[^/\\\x00]*$")] = Field(
        "", description="Name in reports and folders, without slashes; empty: the file's name"
    )
    description: str = Field("", description="One line about the experiment, for lists and reports")
    seed: Annotated[int, Field(ge=0, lt=2**53)] = Field(
        1, description="Seed of all random numbers: link, sensor noise and random steps"
    )
    mission: Annotated[
        Annotated[str, Tag("<name>")] | Annotated[Mission, Tag("<inline>")],
        Discriminator(_name_or_inline),
    ] = Field("pipes", description="Name of a shipped mission, a path, or the mission itself")
    world: World = World()
    guard: Guard = Guard()
    tunnel: Tunnel = Tunnel()
    link: Link = Link()
    cloud: Cloud = Cloud()
    criteria: Criteria = Criteria()
    report: Report = Report()
