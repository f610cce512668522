"""The experiment file as frozen objects: every key, its unit, range and default.

Keys carry their unit (`delay_ms`); `cloudrc/assembly.py` converts them to SI once. Unknown keys
are refused. Defaults are the paper's scheme with the published gains.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

Finite = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


class Section(BaseModel):
    """A part of the experiment file: frozen, closed, strictly typed."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class Waypoint(Section):
    """A point to fly to."""

    position_m: tuple[Finite, Finite, Finite] = Field(description="Base position [m], world frame")
    yaw_deg: Finite = Field(0.0, description="Heading [deg]")
    tolerance_m: Positive = Field(0.10, description="Distance that counts as there [m]")
    dwell_s: NotNegative = Field(0.5, description="How long to stay within the tolerance [s]")
    time_limit_s: Positive = Field(60.0, description="Time allowed for this leg [s]")


class Steps(Section):
    """Seeded random setpoints, one after the other: for judging predictors."""

    count: Annotated[int, Field(ge=1, le=1000)] = Field(10, description="Number of steps")
    period_s: Positive = Field(4.0, description="Time between two steps [s]")
    centre_m: tuple[Finite, Finite, Finite] = Field((0.0, 0.0, 1.2), description="Centre [m]")
    range_m: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (1.0, 1.0, 0.7), description="Largest distance from the centre per axis [m]"
    )


class Mission(Section):
    """What to fly: waypoints, or random steps."""

    start: Literal["spawn", "here"] = Field("spawn", description="Where the mission starts")
    waypoints: tuple[Waypoint, ...] = Field((), max_length=10_000, description="Points, in order")
    steps: Steps | None = Field(None, description="Random steps in place of waypoints")


class LowLevel(Section):
    """Onboard velocity and attitude loops (plant.md: the published gains at the true dt)."""

    gain_p: tuple[NotNegative, NotNegative, NotNegative] = Field((4.0, 4.0, 10.0))
    gain_i: tuple[NotNegative, NotNegative, NotNegative] = Field((1.0, 1.0, 2.5))
    gain_d: tuple[NotNegative, NotNegative, NotNegative] = Field((0.30, 0.30, 0.50))
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

    command_age_max_ms: Positive | None = Field(
        None,
        description="A command whose basis is older is not flown [ms]; "
        "default: the link profile's own, else 250",
    )
    speed_max_mps: Positive = Field(6.0, description="Cap on the commanded speed [m/s]")
    acceleration_max_mps2: Positive = Field(12.0, description="Cap on its change [m/s^2]")
    yaw_rate_max_radps: Positive = Field(1.0, description="Cap on the yaw rate [rad/s]")


class Tunnel(Section):
    """How the two ends treat late datagrams."""

    order: Literal["newest", "arrival"] = Field(
        "newest", description="newest: a late one is dropped; arrival: the last to arrive wins"
    )


class GilbertElliott(Section):
    """Loss in bursts: a two-state Markov chain that advances with every packet."""

    bad_start: Share = Field(description="Chance per packet to go from the good to the bad state")
    bad_end: Share = Field(description="Chance per packet to go from the bad to the good state")
    loss_bad: Share = Field(1.0, description="Loss in the bad state")
    loss_good: Share = Field(0.0, description="Loss in the good state")
    delay_bad_ms: NotNegative = Field(0.0, description="Extra delay in the bad state, one way [ms]")


class Blackout(Section):
    """A time in which nothing passes."""

    start_s: NotNegative = Field(description="Since the link came up [s]")
    duration_s: Positive = Field(description="[s]")


class Change(Section):
    """From `at_s` on these values hold; those not named stay as they are."""

    at_s: NotNegative = Field(description="Since the link came up [s]")
    delay_ms: NotNegative | None = None
    jitter_ms: NotNegative | None = None
    loss: Share | GilbertElliott | None = None
    rate_kbit: Positive | None = None


class Direction(Section):
    """Network conditions of one direction. All delays are ONE WAY."""

    delay_ms: NotNegative = Field(0.0, description="One way [ms]")
    jitter_ms: NotNegative = Field(
        0.0, description="uniform: half width; normal, pareto: standard deviation [ms]"
    )
    distribution: Literal["uniform", "normal", "pareto"] = Field("uniform")
    correlation: Share = Field(0.0, description="Of the jitter of one packet with the next")
    loss: Share | GilbertElliott = Field(0.0, description="Chance, or bursts")
    duplicate: Share = Field(0.0, description="Chance that a packet arrives twice")
    reorder: Share = Field(0.0, description="Chance that a packet overtakes: no delay at all")
    keep_order: bool = Field(False, description="Packets never overtake each other")
    rate_kbit: Positive | None = Field(None, description="Rate of the bottleneck [kbit/s]")
    queue_packets: Annotated[int, Field(ge=1, le=1_000_000)] = Field(
        1000, description="Packets that wait at the bottleneck before the next is dropped"
    )
    changes: tuple[Change, ...] = Field((), description="Time line, rising in at_s")
    trace: str | None = Field(None, description="CSV file: time_s,delay_ms[,loss]")
    blackouts: tuple[Blackout, ...] = ()


class Profile(Section):
    """A file under link/profiles."""

    description: str = ""
    uplink: Direction = Direction()
    downlink: Direction = Direction()
    command_age_max_ms: Positive | None = Field(
        None, description="Command age limit that this link needs [ms]"
    )


class Link(Section):
    """The emulated network: a profile, and single values over it."""

    profile: str = Field("paper-p2", description="File name under link/profiles, or a path")
    uplink: dict[str, Any] = Field({}, description="Overrides of world to cloud")
    downlink: dict[str, Any] = Field({}, description="Overrides of cloud to world")


class PlugIn(Section):
    """A plug-in by name, with its parameters beside it."""

    model_config = ConfigDict(extra="allow", frozen=True, strict=True)
    name: str


class Cloud(Section):
    """The remote controller."""

    estimator: str | PlugIn = "running_mean"
    predictor: str | PlugIn = "constant_velocity"
    controller: str | PlugIn = "pid"


class Criteria(Section):
    """What makes a flight a success."""

    contact: bool = Field(True, description="The tip has to touch the board")
    contact_speed_max_mps: Positive = Field(0.25, description="Tip speed allowed there [m/s]")
    time_limit_s: Positive = Field(60.0, description="Since the mission began [s]")


class Experiment(Section):
    """One experiment file."""

    description: str = ""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    mission: str | Mission = Field("pipes", description="A shipped mission, a file, or inline")
    world: World = World()
    guard: Guard = Guard()
    tunnel: Tunnel = Tunnel()
    link: Link = Link()
    cloud: Cloud = Cloud()
    criteria: Criteria = Criteria()
