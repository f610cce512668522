"""Define every key of experiments, missions and link profiles, with its unit, range and default.

The name of a key ends with its unit (`delay_ms`); `cloudrc/assembly.py` converts the values to SI
units. Unknown keys are refused. The defaults are the control scheme and the gains of the paper.
`Experiment` describes a file. `config.load.ResolvedExperiment` is the result of loading the file.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any, Literal, TypeVar

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
Point = tuple[Finite, Finite, Finite]
NotNegative = Annotated[float, Field(ge=0)]
NotNegatives = tuple[NotNegative, NotNegative, NotNegative]
Positive = Annotated[float, Field(gt=0)]
# Every limit of the guard has a smallest and a largest value, so that nobody can switch it off.
COMMAND_AGE_MS = 1, 10_000
"""Smallest and largest value of guard.command_age_max_ms [ms]."""
CommandAge = Annotated[float, Field(ge=COMMAND_AGE_MS[0], le=COMMAND_AGE_MS[1])]
Speed = Annotated[float, Field(ge=0.01, le=10)]
Acceleration = Annotated[float, Field(ge=0.1, le=100)]
YawRate = Annotated[float, Field(ge=0.01, le=10)]
HoldTime = Annotated[float, Field(ge=0.1, le=3600)]
DURATION_MAX = 1_000_000
"""Largest value of a time limit, or of a dwell time in a mission [s]: eleven days."""
Dwell = Annotated[float, Field(ge=0, le=DURATION_MAX)]
TimeLimit = Annotated[float, Field(gt=0, le=DURATION_MAX)]
Probability = Annotated[float, Field(ge=0, le=1)]


class Section(BaseModel):
    """A section of a file: immutable, strictly typed, without unknown keys or infinite numbers."""

    model_config = ConfigDict(
        extra="forbid",
        frozen=True,
        strict=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )


class GilbertElliott(Section):
    """Loss in bursts: a two-state Markov chain that takes one step per packet."""

    bad_start: Probability
    """Chance per packet that the good state turns bad, 0 to 1; 0: no burst begins"""
    bad_end: Probability
    """Chance per packet that the bad state turns good, 0 to 1; a burst has 1 / bad_end packets on
    average. Must be above 0 if bad_start is"""
    loss_bad: Probability = 1.0
    """Chance that a packet is lost in the bad state, 0 to 1; 1: all are lost"""
    loss_good: Probability = 0.0
    """Chance that a packet is lost in the good state, 0 to 1; 0: none is lost"""
    delay_bad_ms: NotNegative = 0.0
    """Extra one-way delay in the bad state [ms]; netem refuses a value above 0"""

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

    start_s: NotNegative
    """Start, in time since the link came up [s]"""
    duration_s: Positive
    """Length [s], above 0"""


class Change(Section):
    """New conditions from `at_s` on; every key that is not given keeps its value."""

    at_s: NotNegative
    """Start, in time since the link came up [s]"""
    delay_ms: NotNegative | None = None
    """New mean one-way delay [ms]; null: unchanged"""
    jitter_ms: NotNegative | None = None
    """New jitter [ms], as in the direction; null: unchanged"""
    loss: Loss | None = None
    """New loss, a chance from 0 to 1 or bursts; null: unchanged"""
    rate_kbit: Positive | None = None
    """New rate of the bottleneck [kbit/s]; null: unchanged"""


class Direction(Section):
    """Network conditions of one direction. All delays are ONE WAY."""

    delay_ms: NotNegative = 0.0
    """Mean one-way delay [ms]; a round trip is the sum of both directions"""
    jitter_ms: NotNegative = 0.0
    """Spread of the delay [ms]; half width of uniform, standard deviation of the other
    distributions. A delay below 0 becomes 0, which raises the mean"""
    distribution: Literal["uniform", "normal", "pareto", "table"] = "uniform"
    """Distribution of the jitter; pareto has a long tail; table: that of the delays in the file
    `table`"""
    table: str | None = None
    """CSV file as for `trace`; its delays, shifted to mean 0 and scaled to `jitter_ms`, are the
    distribution. Needed with distribution: table"""
    correlation: Probability = 0.0
    """Correlation of a packet's jitter with the next packet's, 0 to 1"""
    loss: Loss = 0.0
    """Loss: a chance per packet from 0 to 1, or a mapping for loss in bursts"""
    duplicate: Probability = 0.0
    """Chance that a packet arrives twice, 0 to 1; the copy has its own delay"""
    reorder: Probability = 0.0
    """Chance that a packet has no delay and overtakes others, 0 to 1; no effect with keep_order"""
    corrupt: Probability = 0.0
    """Chance that one bit of a packet is flipped, 0 to 1; the receiver refuses such a packet"""
    keep_order: bool = False
    """Whether packets arrive in the order of sending, as from a queue"""
    rate_kbit: Positive | None = None
    """Rate of the bottleneck [kbit/s], 28 bytes of headers included; null: none"""
    queue_packets: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """Packets that the bottleneck holds, with the one being sent; further packets are dropped"""
    changes: tuple[Change, ...] = ()
    """Changes of the conditions over time; at_s must rise"""
    trace: str | None = None
    """CSV file with the columns time_s,delay_ms[,loss]; it replaces delay_ms, and loss if it has
    that column. A relative path starts at the file that names it"""
    loop: bool = False
    """Whether the trace begins again after its end; then changes and blackouts repeat with it. Not
    for netem"""
    blackouts: tuple[Blackout, ...] = ()
    """Intervals in which every packet is lost; they may overlap"""

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

    description: str = ""
    """One line about the profile, for lists"""
    uplink: Direction = Direction()
    """Conditions from world to cloud"""
    downlink: Direction = Direction()
    """Conditions from cloud to world"""
    command_age_max_ms: CommandAge | None = None
    """Default of guard.command_age_max_ms with this profile [ms]; null: 250"""


MAX_WAYPOINTS = 10_000
"""Largest number of waypoints in a mission."""


def _name_or_inline(value: Any) -> str:
    return "<name>" if isinstance(value, str) else "<inline>"


_Section = TypeVar("_Section", bound=Section)
NameOr = Annotated[
    Annotated[str, Tag("<name>")] | Annotated[_Section, Tag("<inline>")],
    Discriminator(_name_or_inline),
]
"""The name of a file or plug-in, or its contents."""


class Waypoint(Section):
    """A point to fly to."""

    position_m: Point
    """Position of the base [m], world frame; must be where the guard lets the robot fly and clear
    of the pipes' walls, and so must the straight way there"""
    yaw_deg: Finite = 0.0
    """Heading [deg]; only 0 is accepted, the onboard controller holds yaw at 0"""
    tolerance_m: Positive = 0.10
    """Distance from the point at which it counts as reached [m]"""
    dwell_s: Dwell = 0.5
    """Time that the robot must stay within the tolerance [s]; 0: it flies on"""
    time_limit_s: TimeLimit | None = None
    """Time limit for the leg to this point [s]; a HOLD does not count. Beyond it the mission fails.
    null: 3 times the expected time"""


class Steps(Section):
    """Random setpoints in sequence, drawn from the seed, to compare predictors."""

    count: Annotated[int, Field(ge=1, le=1000)] = 10
    """Number of setpoints"""
    period_s: TimeLimit = 4.0
    """Time between two setpoints [s], whether or not the first was reached"""
    centre_m: Point = (0.0, 0.0, 1.2)
    """Centre of the box of setpoints [m], world frame"""
    range_m: NotNegatives = (1.0, 1.0, 0.7)
    """Half the size of that box per axis [m]; it must be inside the fence and clear of the pipes'
    walls"""


class Mission(Section):
    """A mission: waypoints, or random steps."""

    description: str = ""
    """One line about the mission, for lists"""
    start: Literal["spawn", "here"] = "spawn"
    """Where the mission starts; spawn: the robot's place on the ground; here: where the robot is"""
    waypoints: tuple[Waypoint, ...] = Field((), max_length=MAX_WAYPOINTS)
    """Points to fly to in this order, at most 10000"""
    steps: Steps | None = None
    """Random setpoints in place of waypoints"""


class LowLevel(Section):
    """The onboard velocity loop: the published gains at the true time step."""

    gain_p: NotNegatives = (4.0, 4.0, 10.0)
    """Proportional gain per axis [N/(m/s)]; 0 switches the term off"""
    gain_i: NotNegatives = (1.0, 1.0, 2.5)
    """Integral gain per axis [N/m]; 0 switches the term off"""
    gain_d: NotNegatives = (0.30, 0.30, 0.50)
    """Derivative gain per axis [N/(m/s^2)]; 0 switches the term off"""
    integral_limit_xy: NotNegative = 0.10
    """Limit on the integral of the velocity error in x and y [m]; it is clipped there"""
    integral_limit_z: NotNegative = 0.40
    """Limit on the integral of the velocity error in z [m]; it is clipped there"""


class Sensors(Section):
    """White noise on the odometry for cloud; the onboard controller sees the true state."""

    position_noise_m: NotNegative = 0.0
    """Standard deviation of the position noise per axis [m]; 0: none"""
    velocity_noise_mps: NotNegative = 0.0
    """Standard deviation of the velocity noise per axis [m/s]; 0: none"""


class World(Section):
    """The robot and its scene."""

    robot: str = "pelican"
    """Robot that ships with cloudrc, or a path of an MJCF file (.xml) for which the onboard
    controller is made: mass, inertia, rotors"""
    scene: str = "pipes"
    """Scene that ships with cloudrc, or a path of an MJCF file (.xml)"""
    low_level: LowLevel = LowLevel()
    sensors: Sensors = Sensors()


class Guard(Section):
    """Limits of the onboard guard; only world reads them."""

    command_age_max_ms: CommandAge | None = None
    """Age limit of a command [ms], counted from the odometry that it is based on. The robot holds
    its position if its newest command is older. null: the link profile's value, else 250"""
    speed_max_mps: Speed | None = None
    """Cap on the commanded speed [m/s]; a faster command is shortened. null: the largest speed
    from which the robot stops within 8.7 m despite commands of that age, 6 at 250 ms; a larger
    value is refused"""
    acceleration_max_mps2: Acceleration = 12.0
    """Cap on the change of the reference velocity [m/s^2]"""
    yaw_rate_max_radps: YawRate = 1.0
    """Cap on the commanded yaw rate [rad/s]; a faster command is shortened"""
    hold_max_s: HoldTime = 60.0
    """Time in HOLD during a mission after which the robot lands [s]. On the ground the mission ends
    after the same time without a fresh command, at least 10 s. Below 1 s minus
    guard.command_age_max_ms, every silence in flight ends in LAND"""


class Tunnel(Section):
    """How both ends treat late datagrams."""

    order: Literal["newest", "arrival"] = "newest"
    """Which datagram counts; newest: the last sent, a late one is dropped; arrival: the last to
    arrive"""


class Link(Section):
    """The emulated network: a profile, and single values that override the profile's values."""

    profile: str = "paper-p2"
    """Name of a shipped link profile, or a path"""
    uplink: Direction = Direction()
    """Conditions from world to cloud; a key here overrides the profile"""
    downlink: Direction = Direction()
    """Conditions from cloud to world; a key here overrides the profile"""


class PlugIn(Section):
    """A plug-in by name, and its parameters as further keys."""

    model_config = ConfigDict(extra="allow")
    name: str
    """Name of a plug-in that is shipped or installed, or a path of a Python file"""


PlugInChoice = NameOr[PlugIn]


class Cloud(Section):
    """The remote controller."""

    estimator: PlugInChoice = "running_mean"
    """Estimates the delays: a name, or a mapping with parameters"""
    predictor: PlugInChoice = "constant_velocity"
    """Predicts the odometry at the time at which a command takes effect: a name, or a mapping with
    parameters"""
    controller: PlugInChoice = "pid"
    """Tracks the setpoint: a name, or a mapping with parameters"""


class Criteria(Section):
    """What a flight needs to count as a success."""

    contact: bool = True
    """Whether the tip of the arm must touch the board"""
    contact_speed_max_mps: Positive = 0.25
    """Largest speed of the tip at that touch [m/s]; a faster one is a failure"""
    time_limit_s: TimeLimit = 60.0
    """Time limit of the mission [s], counted from its start; then it fails"""


class Report(Section):
    """Additions to the report of a run."""

    metrics: tuple[str, ...] = ()
    """Your own metrics for `cloudrc run`: paths of Python files; a name here must be installed,
    else the run is refused"""


class Experiment(Section):
    """An experiment file."""

    # No slash: a run's folder has this name.
    name: Annotated[str, Field(pattern=r"^[^/\\\x00]*$")] = ""
    """Name in reports and folders, without slashes; empty: the file's name"""
    description: str = ""
    """One line about the experiment, for lists and reports"""
    seed: Annotated[int, Field(ge=0, lt=2**53)] = 1
    """Seed of all random numbers: link, sensor noise and random steps"""
    mission: NameOr[Mission] = "pipes"
    """Name of a shipped mission, a path, or the mission itself"""
    world: World = World()
    guard: Guard = Guard()
    tunnel: Tunnel = Tunnel()
    link: Link = Link()
    cloud: Cloud = Cloud()
    criteria: Criteria = Criteria()
    report: Report = Report()
