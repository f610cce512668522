# SPDX-License-Identifier: Apache-2.0

"""Define every key of experiments and missions, with its unit, range and default.

The name of a key ends with its unit (`delay_ms`); `flight/assembly/` and `link/` convert the
values to SI units. Unknown keys are refused. The defaults are the control scheme and the gains
of the paper. `Experiment` describes a file. `config.load.ResolvedExperiment` is the result of
loading the file.
"""

from __future__ import annotations

from math import radians
from pathlib import PurePath
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    field_validator,
    model_validator,
)

from cloudrc.base.outside.address import check_url
from cloudrc.config.camera import CodecConfig
from cloudrc.config.choice import NameOr
from cloudrc.config.cloud import Cloud
from cloudrc.config.disturbances import Plant, SensorsConfig, WindConfig
from cloudrc.config.faults import FaultConfig
from cloudrc.config.fleet import CellConfig, FleetConfig
from cloudrc.config.follow import Follow
from cloudrc.config.profile import CommandAge, DirectionConfig, StartConfig
from cloudrc.config.section import Section, leave_out_unset
from cloudrc.link.profile import NotNegative as NotNegative
from cloudrc.link.profile import Positive as Positive
from cloudrc.link.profile import refuse_start
from cloudrc.physics.geometry.fence import Corners, order_of
from cloudrc.wire.messages import TOUCH_NAME_MAX

Finite = Annotated[float, Field(allow_inf_nan=False)]
Point = tuple[Finite, Finite, Finite]


def _with_height(value: Any) -> Any:
    return [*value, GROUND] if isinstance(value, list | tuple) and len(value) == 2 else value


GROUND = 0.0
"""Height of a place that is given by two numbers [m]; `config.ground` replaces it."""
Place = Annotated[
    Point,
    Field(strict=False, json_schema_extra={"minItems": 2}),
    BeforeValidator(_with_height),
]
"""A point; a robot that stays on the ground needs no third number."""
ServerUrl = Annotated[str, AfterValidator(check_url)]
"""Address of a policy's server, such as ws://127.0.0.1:8000."""
_ROS_NAME = "[A-Za-z_][A-Za-z0-9_]*"
RosNamespace = Annotated[str, Field(pattern=f"^(/?{_ROS_NAME}(/{_ROS_NAME})*)?$")]
"""Namespace of ROS 2, such as drone1."""
NotNegatives = tuple[NotNegative, NotNegative, NotNegative]
Tilt = Annotated[float, Field(gt=0, le=60)]
"""Limit of a tilt [deg]. Beyond 78 degrees the guard stops the robot."""
_Constant = Annotated[float, Field(gt=0, le=30)]
_DeadTime = Annotated[float, Field(ge=0, le=5)]
Constants = tuple[_Constant, _Constant, _Constant]
DeadTimes = tuple[_DeadTime, _DeadTime, _DeadTime]
"""Time constants and dead times of a robot's velocity loop per axis [s]. Larger values are meant in
milliseconds."""
Gain = Annotated[float, Field(gt=0, le=1)]
Seed = Annotated[int, Field(ge=0, lt=2**53)]
# Every limit of the guard has a smallest and a largest value, so that nobody can switch it off.
SPEED_MPS = 0.01, 10.0
"""Smallest and largest value of guard.speed_max_mps [m/s]."""
Speed = Annotated[float, Field(ge=SPEED_MPS[0], le=SPEED_MPS[1])]
Acceleration = Annotated[float, Field(ge=0.1, le=100)]
PlanMax = Annotated[float, Field(ge=0, le=2)]
HoldTime = Annotated[float, Field(ge=0.1, le=3600)]
DURATION_MAX = 1_000_000
"""Largest value of a time limit, or of a dwell time in a mission [s]: eleven days."""
Dwell = Annotated[float, Field(ge=0, le=DURATION_MAX)]
TimeLimit = Annotated[float, Field(gt=0, le=DURATION_MAX)]
MAX_WAYPOINTS = 10_000
"""Largest number of waypoints in a mission."""


YAW_TOLERANCE_DEG = 5.0
"""Default of yaw_tolerance_deg of a waypoint [deg]."""
Yaw = Annotated[float, Field(ge=-360, le=360)]
YawTolerance = Annotated[float, Field(gt=0, le=180)]


class Waypoint(Section):
    """A point to fly to."""

    position_m: Place
    """Position of the base [m], world frame; two numbers for a robot that stays on the ground. The
    guard must allow the point and the straight line to it, and both must be clear of obstacles"""
    yaw_deg: Yaw | None = None
    """Heading of the robot at the point [deg], counter-clockwise from the x axis. The robot turns
    the shorter way around, while it flies there. Only for a robot that obeys a yaw, see heading in
    robot.yaml. null: the robot keeps its heading"""
    yaw_tolerance_deg: YawTolerance | None = None
    """Difference from yaw_deg [deg] within which the point counts as reached. null: 5"""
    tolerance_m: Positive = 0.10
    """Distance [m] within which the point counts as reached"""
    dwell_s: Dwell = 0.5
    """Time that the robot must stay within the tolerance [s]; 0: the robot flies on at once"""
    time_limit_s: TimeLimit | None = None
    """Time limit for the flight to this point [s], not counting time in HOLD; after it the
    mission fails. null: 3 times the expected time"""
    speed_mps: Speed | None = None
    """Largest speed of the moving setpoint on the way to this point [m/s]; only with the key
    carrot. null: carrot.speed_mps"""

    @property
    def yaw_tolerance(self) -> float:
        """Difference from the yaw within which the point counts as reached [rad]."""
        return radians(self.yaw_tolerance_deg or YAW_TOLERANCE_DEG)


class Carrot(Section):
    """A setpoint that moves straight from waypoint to waypoint and rests at each for its dwell_s.

    It moves with time and does not wait for the robot, so delays do not prolong the mission.
    """

    speed_mps: Speed = 2.0
    """Largest speed of the setpoint [m/s]"""
    acceleration_mps2: Annotated[float, Field(ge=0.1, le=10)] = 2.0
    """Acceleration and deceleration of the setpoint [m/s^2]"""


class Steps(Section):
    """A sequence of random setpoints, made from the seed, to compare predictors."""

    count: Annotated[int, Field(ge=1, le=1000)] = 10
    """Number of setpoints"""
    period_s: TimeLimit = 4.0
    """Time between two setpoints [s]"""
    centre_m: Point = (0.0, 0.0, 1.2)
    """Centre of the box of setpoints [m], world frame"""
    range_m: NotNegatives = (1.0, 1.0, 0.7)
    """Half the size of the box per axis [m]; the box must be inside the fence and clear of
    obstacles"""


class Touch(Section):
    """The body of the scene that the robot has to touch in a mission."""

    body: Annotated[str, Field(min_length=1)]
    """Name of the body. All other bodies but floor are obstacles"""
    speed_max_mps: Positive = 0.25
    """Largest speed at the first touch [m/s]; with a higher speed the mission fails"""

    @field_validator("body")
    @classmethod
    def _fits(cls, body: str) -> str:
        if len(body.encode()) > TOUCH_NAME_MAX:
            raise ValueError(f"must have at most {TOUCH_NAME_MAX} bytes; rename the body")
        return body


JudgedBy = Literal["measured", "predicted"]


class MissionConfig(Section):
    """A mission: waypoints, random steps, or setpoints from a file."""

    description: str = ""
    """One line about the mission, for lists"""
    start: Literal["spawn", "here"] = "spawn"
    """Where the mission starts; spawn: the start position on the ground; here: where the robot
    is"""
    waypoints: tuple[Waypoint, ...] = Field((), max_length=MAX_WAYPOINTS)
    """Points to fly to, in this order"""
    steps: Steps | None = None
    """Random setpoints in place of waypoints"""
    setpoints: str | None = None
    """CSV file with the columns time_s,x_m,y_m,z_m, in place of waypoints: the position of the
    setpoint over time, with straight lines between the rows. A robot on the ground needs no z_m.
    The mission ends with the last row; the robot must then be within criteria.settle_m of it. A
    drive by hand writes such a file, drive.csv"""
    follow: Follow | None = None
    """A moving body to keep in the camera's picture, in place of waypoints"""
    carrot: Carrot | None = None
    """Moves the setpoint at limited speed from waypoint to waypoint; null: the setpoint jumps"""
    judged_by: JudgedBy = "measured"
    """Position by which teleop sees that the robot has reached a waypoint. measured: the newest one
    in telemetry, so that the robot waits a round trip at each waypoint; predicted: that of cloud's
    predictor, for the time at which the next command arrives. The report judges by the true path"""
    touch: Touch | None = None
    """What the robot has to touch; null: nothing, every body but floor is an obstacle"""

    _write = leave_out_unset("follow")

    @property
    def touched(self) -> str | None:
        """Name of the body that the robot has to touch; None without one."""
        return self.touch.body if self.touch else None

    @property
    def turns(self) -> bool:
        """Whether a waypoint has a yaw."""
        return any(waypoint.yaw_deg is not None for waypoint in self.waypoints)

    @property
    def contents(self) -> str:
        """What the mission flies, in words, such as "7 waypoints"."""
        if self.setpoints:
            return f"setpoints of {PurePath(self.setpoints).name}"
        if self.follow:
            return f"following {self.follow.target} for {self.follow.duration_s:g} s"
        return f"{self.count} {self.unit}{'s' * (self.count != 1)}"

    @property
    def unit(self) -> str:
        """What a mission counts: "waypoint" or "step"; "" for a file of setpoints."""
        return "" if self.setpoints else "step" if self.steps else "waypoint"

    @property
    def count(self) -> int:
        """Number of waypoints or random setpoints; what ends with time counts as one waypoint."""
        ends = self.setpoints or self.follow
        return self.steps.count if self.steps else 1 if ends else len(self.waypoints)


class Parameters(Section):
    """Parameters of a plug-in, whose signature says which there are."""

    model_config = ConfigDict(extra="allow")


class World(Section):
    """The robot and its scene."""

    robot: str = "pelican"
    """Name of a shipped robot, or path of a folder with robot.yaml or of an MJCF file (.xml). The
    robot must be one that its onboard controller can fly or drive"""
    scene: str = "pipes"
    """Name of a shipped scene, or path of an MJCF file (.xml)"""
    fence_m: tuple[Point, Point] | None = None
    """Fence: the box that the robot's base may not leave, as its corners with the smallest and the
    largest x, y and z [m], world frame. null: the scene's fence, a numeric of that name in its
    file, else the box around its geoms with 3 m on all sides"""
    tuning: str | None = None
    """Name of a set of parameters in the robot's robot.yaml (tunings), such as fast. null: without
    one"""
    onboard: Parameters = Parameters()
    """Parameters of the onboard controller, in place of those in robot.yaml and in its tuning"""
    sensors: SensorsConfig = SensorsConfig()
    """Errors of the odometry for cloud; guard and onboard controller see the true state"""
    plant: Plant = Plant()
    """How the true robot differs from its model; guard, onboard controller and cloud use the
    model. A heavy or weak robot brakes worse, so the guard may stop it too late"""
    wind: WindConfig = WindConfig()
    """Horizontal wind. It acts on the actuators alone, by their drag, so it does not move a robot
    whose actuators are off. A robot whose actuators have no drag is refused"""
    scan: bool = False
    """Whether the robot's scanner works without a cloud.perception, too: the scans then go to the
    recording alone"""
    odometry_rate_hz: Literal[20, 25, 50, 100, 125, 250, 500] = 100
    """Rate of the odometry for cloud [Hz]. The true state is recorded at 100 Hz or more"""

    _write = leave_out_unset("scan")

    @field_validator("fence_m")
    @classmethod
    def _check_fence(cls, corners: Corners | None) -> Corners | None:
        if corners and (wrong := order_of(corners)):
            raise ValueError(wrong)
        return corners

    @property
    def is_nominal(self) -> bool:
        """Whether there is no wind and the true robot equals its model."""
        return self.plant == Plant() and not self.wind.blows


class GuardConfig(Section):
    """Limits of the onboard guard; only world reads them."""

    command_age_max_ms: CommandAge | None = None
    """Largest age of a command [ms], counted from the odometry from which cloud computed it. If the
    newest command is older, the robot holds its position. null: the link profile's value, else
    250"""
    plan_max_s: PlanMax | None = None
    """Longest time for which the robot follows the plan of a command (cloud.plan_s) after the
    arrival of the command [s]. 0: only while the command is younger than command_age_max_ms.
    null: 0.8 if cloud.plan_s is above 0, else 0"""
    speed_max_mps: Speed | None = None
    """Cap on the commanded speed [m/s]; a faster command is shortened. null: the largest speed that
    the robot can follow and from which it stops within the longest way from the spawn to a wall of
    the fence, less 0.5 m. For the Pelican in the shipped scenes this is 6 m/s if command_age_max_ms
    is 250 and plan_max_s is 0"""
    acceleration_max_mps2: Acceleration | None = None
    """Largest acceleration of the velocity that the onboard controller follows [m/s^2]. null: that
    of the robot, for the Pelican 12; a larger value is refused"""
    yaw_rate_max_radps: Speed = 1.0
    """Cap on the commanded yaw rate [rad/s]; a faster command is shortened"""
    hold_max_s: HoldTime = 60.0
    """Longest time in HOLD during a mission [s]; then the robot lands. In HOLD the guard keeps the
    robot in place, because commands are missing. On the ground, the mission ends if no fresh
    command arrives for this time, but not before 10 s. With a value below 1 s minus
    command_age_max_ms, every HOLD in flight ends in a landing"""


class Tunnel(Section):
    """How world and cloud treat datagrams that arrive out of order."""

    order: Literal["newest", "arrival"] = "newest"
    """newest: a datagram that arrives after a newer one is dropped; arrival: the datagram that
    arrived last is used"""


class Link(Section):
    """The emulated network: a profile, and single values that override the profile's values."""

    profile: str = "paper-p2"
    """Name of a shipped link profile, or a path"""
    uplink: DirectionConfig = DirectionConfig()
    """Conditions from world to cloud; a key here overrides the profile"""
    downlink: DirectionConfig = DirectionConfig()
    """Conditions from cloud to world; a key here overrides the profile"""
    start_s: StartConfig | None = None
    """Where in the schedule of the link the flight begins [s], or random: drawn from the seed, and
    the schedule repeats. null: the profile's value, else 0"""

    _write = leave_out_unset("start_s")

    @model_validator(mode="after")
    def _refuse_start(self) -> Link:
        if text := refuse_start(self.start_s, self.uplink, self.downlink):
            raise ValueError(text)
        return self


class Criteria(Section):
    """Conditions for the success of a flight."""

    settle_m: Positive | None = 0.15
    """Largest distance from the setpoint in the last 0.5 s of each random step, and from the last
    setpoint of a file when the mission ends [m]. An oscillation that does not decay fails a
    mission, too, with or without random steps. null: neither distance nor oscillation is judged"""
    time_limit_s: TimeLimit | None = None
    """Time limit of the mission [s], counted from its start; after this time the mission fails.
    null: 3 times the expected time, but at least 60 s"""
    age_deadline_s: Positive | None = None
    """Age of information at the actuator [s], for the number `age_violation`: the share of the time
    above this age. No flight fails for it. null: no such number"""


class Report(Section):
    """The user's additions to the report of a run."""

    metrics: tuple[str, ...] = ()
    """Your own metrics for `cloudrc run`: paths of Python files, or names of installed metrics"""


class Experiment(Section):
    """An experiment file."""

    # No slash: a run's folder has this name.
    name: Annotated[str, Field(pattern=r"^[^/\\\x00]*$")] = ""
    """Name in reports and folders, without slashes; empty: the file's name"""
    description: str = ""
    """One line about the experiment, for lists and reports"""
    seed: Seed = 1
    """Seed of all random numbers: link, sensor noise, wind, compute time and random steps"""
    mission: NameOr[MissionConfig] = "pipes"
    """Name of a shipped mission, a path, or the mission itself"""
    world: World = World()
    guard: GuardConfig = GuardConfig()
    tunnel: Tunnel = Tunnel()
    link: Link = Link()
    cell: CellConfig = CellConfig()
    cloud: Cloud = Cloud()
    camera: CodecConfig | None = None
    """The robot's camera works, and how its pictures travel to cloud. null: it does not work"""
    fleet: FleetConfig = FleetConfig()
    criteria: Criteria = Criteria()
    report: Report = Report()
    faults: tuple[FaultConfig, ...] = ()
    """Faults that are injected in flight, in any order"""

    _write = leave_out_unset("faults", "camera")
