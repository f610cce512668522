# SPDX-License-Identifier: Apache-2.0

"""Read what a robot is: its model, and the onboard controller that flies or drives it.

A robot is a folder with the file `robot.yaml`, or the file of a model alone. Shipped robots are the
folders in `cloudrc/robots/`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, ValidationInfo, field_validator, model_validator

from cloudrc.base.outside.document import read_document
from cloudrc.base.outside.refusal import check_names
from cloudrc.base.outside.reuse import reuse
from cloudrc.base.plugins import is_path
from cloudrc.config import shipped
from cloudrc.config.camera import CameraConfig
from cloudrc.config.choice import PlugIn
from cloudrc.config.heading import Heading
from cloudrc.config.problems import validate
from cloudrc.config.schema import (
    SPEED_MPS,
    Acceleration,
    Constants,
    DeadTimes,
    NotNegatives,
    Parameters,
    Positive,
    Speed,
    World,
)
from cloudrc.config.section import Section
from cloudrc.wire.messages import RAYS_MAX, SENSORS_MAX

Braking = Annotated[float, Field(ge=0.1, le=10)]
Hull = Annotated[float, Field(gt=0, le=10)]


class RobotLimits(Section):
    """What the guard may expect of a robot; an experiment's section `guard` sets lower limits."""

    speed_max_mps: Speed | None = None
    """Largest speed that the robot can follow [m/s]. null: the guard limits the speed only so that
    the robot stops in time"""
    acceleration_max_mps2: Acceleration = 12.0
    """Largest acceleration of the velocity that the robot can follow [m/s^2]; default of
    guard.acceleration_max_mps2. With the onboard controller multirotor, the default is 4"""
    braking_mps2: Braking = 3.0
    """Deceleration that the braking robot always reaches or exceeds [m/s^2]. The guard computes
    the braking distance from it; a wheel has no more than the friction of its tyre, about 10"""
    stop: Literal["land", "brake"] | None = None
    """How a landing ends; land: the robot descends and switches off at touch-down; brake: it brakes
    and switches off at rest. null: brake for a planar robot, else land"""


DEFAULT_LIMITS = RobotLimits()
"""Limits of a robot that flies."""
GENERAL = "multirotor"
"""Onboard controller of a model without `robot.yaml`."""
ON_GROUND = {GENERAL: False, "diff_drive": True}
"""Shipped onboard controller -> whether its robots stay on the ground."""
OF_GENERAL = RobotLimits(acceleration_max_mps2=4.0)
"""Limits of a robot with this onboard controller, if its robot.yaml does not say them. At a tilt of
35 degrees a multirotor has 6.9 m/s^2. With more than 4 m/s^2 on one axis, it would not brake
another axis in time, above all while it sinks."""


class Response(Parameters):
    """First-order model of a robot's velocity loop per axis x, y, z, as `cloudrc identify` fits it.

    What else identify writes, such as the intervals, is for the reader.
    """

    time_constant: Constants
    """Time constant of the velocity loop [s]"""
    dead_time: DeadTimes
    """Time until the robot reacts to a command [s]"""
    gain: NotNegatives
    """Velocity per commanded velocity [1]"""


class Tuning(Parameters):
    """Parameters of the onboard controller, and the model of the velocity loop that they make."""

    response: Response | None = None
    """As response of the robot, but with this tuning. null: predictors take that of the robot"""


SensorName = Annotated[str, Field(pattern="^[a-z][a-z0-9_]{0,39}$")]
Unit = Annotated[str, Field(min_length=1, max_length=16, pattern=r"^\S(.*\S)?$")]


class SensorConfig(Section):
    """A sensor of the robot's own."""

    unit: Unit
    """Unit of its value, such as N or rad/s; 1 without a unit"""
    sensor: Annotated[str, Field(min_length=1)]
    """Name of a sensor of the model that shows one number"""


class ScanConfig(Section):
    """A scanner, which measures distances in a plane, as a LIDAR does."""

    site: Annotated[str, Field(min_length=1)]
    """Name of a site of the model, from which the rays start: its x is ahead, its z is the axis of
    the scan"""
    rays: Annotated[int, Field(ge=2, le=RAYS_MAX)] = 181
    """Number of rays; one datagram carries at most 541"""
    fov_deg: Annotated[float, Field(gt=0, le=360)] = 270.0
    """Angle that the rays cover, half of it to each side [deg]; a ray points to each of its ends"""
    range_m: Annotated[float, Field(gt=0, le=60)] = 10.0
    """Longest distance that the scanner sees [m]"""
    rate_hz: Annotated[int, Field(ge=1, le=100)] = 10
    """Number of scans per second [Hz]"""
    noise_m: Annotated[float, Field(ge=0, le=1)] = 0.01
    """Standard deviation of a distance, from a normal distribution [m]"""


Sensors = Annotated[dict[SensorName, SensorConfig], Field(max_length=SENSORS_MAX)]


def _as_mapping(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


class RobotFiles(Section):
    """The file `robot.yaml`; `find_robot` makes its paths absolute."""

    description: str = ""
    """One line about the robot, for lists"""
    model: Path = Path("robot.xml")
    """MJCF file (.xml) of the robot, in the same folder or a path. Its base has a free joint"""
    onboard: Annotated[PlugIn, BeforeValidator(_as_mapping)]
    """Controller on board, which follows the velocity that the guard allows: the name of a plug-in,
    the path of a Python file, or a mapping with parameters"""
    tunings: dict[str, Tuning] = Field(default_factory=dict)
    """Named sets of parameters, in place of those of onboard; world.tuning chooses one. The shipped
    experiment fast needs one named fast. Each may have a response of its own"""
    response: Response | None = None
    """Model of the velocity loop for predictors without a tuning, the content of a file of `cloudrc
    identify`; null: predictors that need a model refuse the robot"""
    motion: str | None = None
    """Python file with a better model for predictors than response: `build(acceleration_max,
    **parameters)` gets the parameters of the onboard controller. null: there is none"""
    planar: bool = False
    """Whether the robot stays on the ground. Then the guard limits x and y alone, HOLD and LAND
    brake the robot to rest, waypoints have the height of the spawn, and cloud commands no vertical
    velocity"""
    heading: Heading = Field(None, validate_default=True)
    """What decides about the robot's heading; free: the commanded yaw rate, so that waypoints may
    have a yaw_deg; fixed: nothing, the onboard controller holds the yaw at 0; velocity: the robot
    turns towards its velocity. null: velocity for a planar robot, else free"""
    guard: RobotLimits = DEFAULT_LIMITS
    """What the guard may expect of the robot"""
    hull_m: Hull | None = None
    """Radius of the ball about the base that contains the robot [m], for the distance from
    obstacles. null: the smallest ball that contains the geoms of the model"""
    thrust_n_s2: Positive | None = None
    """Thrust of a rotor per squared speed [N s^2], for the energy of the rotors. Their torque is in
    the gear of the model's actuators. null: the energy is not known"""
    probe: Annotated[str, Field(min_length=1)] | None = None
    """Name of a sphere, a site of the model: with it the robot touches what a mission has to touch.
    A touch sensor at this site measures the force. null: any part of the robot touches"""
    sensors: Sensors = Field(default_factory=dict)
    """The robot's own sensors, at most 16: name -> unit, and sensor of the model. Telemetry carries
    their values to cloud"""
    scan: ScanConfig | None = None
    """The robot's scanner. It works only in an experiment that has cloud.perception or world.scan,
    and then sends its scans to cloud. null: the robot has none"""
    camera: CameraConfig | None = None
    """The robot's camera. It works only in an experiment with the section camera. null: the robot
    has none"""
    hull_points: str | None = None
    """Python file with spheres in place of the ball of hull_m: its function `few` returns rows x,
    y, z, radius [m], body frame, for the distance from obstacles. null: there is none"""

    @field_validator("heading", mode="before")
    @classmethod
    def _complete(cls, given: Any, info: ValidationInfo) -> Any:
        return given or ("velocity" if info.data.get("planar") else "free")

    @model_validator(mode="after")
    def _agree(self) -> RobotFiles:
        if self.planar and self.guard.stop == "land":
            raise ValueError("guard.stop is land, but planar robots stay on the ground")
        if self.planar is not ON_GROUND.get(self.onboard.name, self.planar):
            must_be = str(not self.planar).lower()
            raise ValueError(f"the onboard controller {self.onboard.name} needs planar: {must_be}")
        return self


def find_robot(name: str) -> RobotFiles:
    """Return a robot with absolute paths, given by its shipped name, or by an absolute path.

    Raise a BadInputError if its `robot.yaml` is invalid.
    """
    if name.endswith(".xml"):
        return RobotFiles(model=Path(name), onboard=PlugIn(name=GENERAL), guard=OF_GENERAL)
    folder = Path(name) if shipped.is_path(name) else shipped.FOLDERS["robot"] / name
    file = folder / shipped.ROBOT_FILE
    label = str(file) if shipped.is_path(name) else f"{name}/{shipped.ROBOT_FILE}"
    robot = validate(read_document(file, label), RobotFiles, label)
    onboard = robot.onboard
    usual = OF_GENERAL if onboard.name == GENERAL else DEFAULT_LIMITS
    given = robot.guard.model_dump(exclude_unset=True, exclude_none=True)
    if is_path(onboard.name):
        onboard = onboard.model_copy(update={"name": str((folder / onboard.name).resolve())})
    found = {
        "model": folder / robot.model,
        "onboard": onboard,
        "guard": usual.model_copy(update={"stop": "brake" if robot.planar else "land", **given}),
    }
    for key in ("motion", "hull_points"):
        if named := getattr(robot, key):
            found[key] = str((folder / named).resolve())
    return robot.model_copy(update=found)


def parameters(robot: RobotFiles, world: World) -> dict[str, Any]:
    """Return the parameters that the onboard controller gets: of robot.yaml, tuning and world.

    Raises:
        BadInputError: If the robot has no such tuning.
    """
    tuning = world.tuning
    if tuning is not None:
        check_names(f"tuning of {world.robot}", [tuning], sorted(robot.tunings))
    chosen = (robot.onboard, robot.tunings.get(tuning or ""), world.onboard)
    return {
        key: value
        for each in chosen
        if each is not None
        for key, value in (each.model_extra or {}).items()
    }


def known_robot(name: str) -> RobotFiles:
    """Return a robot as `find_robot` does, but read it once for a whole sweep."""
    return reuse(("robot", name), lambda: find_robot(name))


@dataclass(frozen=True)
class RobotFacts:
    """What cloud knows of a robot: predictors and controllers get it as `robot` of `build`."""

    name: str  # as in world.robot
    response: Response | None  # first-order model of the velocity loop, with its tuning
    motion: PlugIn | None  # file of a better model, with the parameters of the onboard controller
    acceleration_max: float  # limit of the guard [m/s^2]
    speed_max: float  # likewise [m/s]
    heading: Heading = "free"  # what decides about its heading


def facts(
    robot: RobotFiles, world: World, acceleration_max: float | None, speed_max: float | None = None
) -> RobotFacts:
    """Return what cloud knows of a robot.

    `acceleration_max` [m/s^2] and `speed_max` [m/s] are the guard's limits, None for the robot's.

    Raises:
        BadInputError: If the robot has no such tuning.
    """
    motion, given = None, parameters(robot, world)
    if robot.motion is not None:
        motion = PlugIn.model_validate({**given, "name": robot.motion})
    tuned = robot.tunings.get(world.tuning or "")
    response = tuned.response if tuned and tuned.response else robot.response
    limit = acceleration_max or robot.guard.acceleration_max_mps2
    speed = speed_max or robot.guard.speed_max_mps or SPEED_MPS[1]
    return RobotFacts(world.robot, response, motion, limit, speed, robot.heading)


def files_of(name: str, robot: RobotFiles) -> list[Path]:
    """Return the files that the user's robot at the path `name` consists of; [] for a shipped one.

    The files that these files name are not in the list.
    """
    if not shipped.is_path(name) and not name.endswith(".xml"):
        return []
    if name.endswith(".xml"):
        return [Path(name)]
    named = robot.onboard.name, robot.motion, robot.hull_points
    own = [Path(file) for file in named if file and is_path(file)]
    return [Path(name) / shipped.ROBOT_FILE, robot.model, *own]
