# SPDX-License-Identifier: Apache-2.0

"""An experiment that is resolved: it contains its mission, and a value for every key."""

from __future__ import annotations

import hashlib
from math import inf, sqrt
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import (
    Field,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    field_validator,
    model_validator,
)

from cloudrc.base.outside.document import write_yaml
from cloudrc.config.choice import PlugIn
from cloudrc.config.cloud import Cloud
from cloudrc.config.faults import OF_LINK, acting, refusal, with_faults
from cloudrc.config.profile import DIRECTIONS, RANDOM, CloudTime, CommandAge, DirectionConfig
from cloudrc.config.robot import DEFAULT_LIMITS, RobotFacts, RobotFiles, RobotLimits, facts
from cloudrc.config.schema import (
    SPEED_MPS,
    Acceleration,
    Experiment,
    GuardConfig,
    MissionConfig,
    PlanMax,
    Speed,
)
from cloudrc.config.world import ResolvedWorld, WorldFiles
from cloudrc.physics.geometry.obstacles import fence_of
from cloudrc.physics.geometry.scene import Scene

HORIZON_MAX_S = 1.0
"""Default of cloud.horizon_max_s [s]. Source: docs/reference/control.md, "Predictors"."""
FREEZE_AFTER_S = 0.4
"""Default of cloud.freeze_after_s [s]. Source: docs/safety.md, "Frozen reference"."""
COMMAND_AGE_MAX_MS = 250.0
"""Default of guard.command_age_max_ms if experiment and link profile give no value [ms].
Source: docs/safety.md, "States"."""
PLAN_MAX_S = 0.8
"""Default of guard.plan_max_s if cloud sends plans [s].
Source: docs/safety.md, "States"."""


class Bounds(NamedTuple):
    """What robot and scene tell about the limits of the guard."""

    robot: RobotLimits
    room: float  # within which the robot stops, see `Fence.room` [m]


def speed_cap(command_age_max_ms: float, plan_max_s: float, bounds: Bounds) -> float:
    """Compute the speed cap: the largest speed v [m/s] from which the robot stops in the fence.

    If commands stop arriving, the robot follows the last one for the time T, reacts within 0.2 s
    and brakes at a, its `braking_mps2`: v · (T + 0.2 s) + v^2 / (2a) = room. T is the largest age
    of a command, `command_age_max_ms` [ms], plus the longest plan, `plan_max_s` [s]. The cap is
    lower for a robot that cannot follow this speed.
    Source: docs/safety.md, "Speed cap".
    """
    robot, room = bounds.robot, max(bounds.room, 0.0)
    delay, braking = command_age_max_ms * 1e-3 + plan_max_s + 0.2, robot.braking_mps2
    stops = round(braking * (sqrt(delay * delay + 2.0 * room / braking) - delay), 6)
    slowest, fastest = SPEED_MPS
    return min(max(stops, slowest), robot.speed_max_mps or fastest)


class ResolvedGuard(GuardConfig):
    """The section `guard`, in which every limit has a value.

    The context of its validation is the `Bounds` of robot and scene; without it, those of `World`.
    """

    command_age_max_ms: CommandAge = COMMAND_AGE_MAX_MS
    plan_max_s: PlanMax = 0.0
    speed_max_mps: Speed = Field(None, validate_default=True)
    acceleration_max_mps2: Acceleration = Field(None, validate_default=True)

    @field_validator("speed_max_mps", mode="wrap")
    @classmethod
    def _limit_speed(
        cls, given: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo
    ) -> float:
        age_max = info.data.get("command_age_max_ms", COMMAND_AGE_MAX_MS)
        plan_max = info.data.get("plan_max_s", 0.0)
        bounds = info.context or bounds_of(ResolvedWorld().files)
        cap = speed_cap(age_max, plan_max, bounds)
        speed_max: float = cap if given is None else check(given)
        if speed_max > cap + 1e-6:
            most = f"{cap:.9g}"
            if cap == bounds.robot.speed_max_mps:
                raise ValueError(f"must be at most {most} m/s, the largest speed of the robot")
            plan = f" and plans of {plan_max:g} s" if plan_max else ""
            raise ValueError(
                f"must be at most {most} m/s: above it the robot does not stop in time, within "
                f"{bounds.room:g} m, with commands {age_max:g} ms old{plan}; lower it or "
                "guard.command_age_max_ms"
            )
        return speed_max

    @field_validator("acceleration_max_mps2", mode="wrap")
    @classmethod
    def _limit_acceleration(
        cls, given: Any, check: ValidatorFunctionWrapHandler, info: ValidationInfo
    ) -> float:
        robot = info.context.robot if info.context else DEFAULT_LIMITS
        most: float = robot.acceleration_max_mps2
        acceleration: float = most if given is None else check(given)
        if info.context and acceleration > most + 1e-6:
            raise ValueError(
                f"must be at most {most:.9g} m/s^2, the largest acceleration of the robot"
            )
        return acceleration


class ResolvedCloud(Cloud):
    """The section `cloud` with all parameters of the plug-ins, including defaults."""

    estimator: PlugIn
    predictor: PlugIn
    controller: PlugIn
    perception: PlugIn | None = None
    horizon_max_s: CloudTime = HORIZON_MAX_S
    freeze_after_s: CloudTime = FREEZE_AFTER_S


class ResolvedExperiment(Experiment):
    """An experiment that contains its mission (not only the name), and a value for every key."""

    mission: MissionConfig
    world: ResolvedWorld = ResolvedWorld()
    guard: ResolvedGuard
    cloud: ResolvedCloud

    @property
    def robot(self) -> RobotFiles:
        """The robot that flies, as its files describe it."""
        return self.world.files.robot

    @property
    def scene(self) -> Scene:
        """Where it flies, with the fence of this experiment."""
        return self.world.files.scene

    @property
    def robot_facts(self) -> RobotFacts:
        """What cloud's plug-ins know of the robot."""
        limits = self.guard.acceleration_max_mps2, self.guard.speed_max_mps
        return facts(self.robot, self.world, *limits)

    @property
    def is_fleet(self) -> bool:
        """Whether the experiment flies several robots, or a robot in a cell."""
        fleet = self.fleet
        return self.cell.rate_kbit is not None or (fleet.robots > 1 and fleet.only is None)

    @property
    def stream(self) -> str:
        """Name of the robot's random numbers; "" for robot 0."""
        return f"robot {self.fleet.only}" if self.fleet.only else ""

    @property
    def scans(self) -> bool:
        """Whether the robot's scanner works: with a camera, a perception looks at pictures."""
        return self.world.scan or (self.cloud.perception is not None and self.camera is None)

    @model_validator(mode="after")
    def _refuse_fleet(self) -> ResolvedExperiment:
        if self.camera is not None and self.fleet.robots > 1:
            raise ValueError("camera: works for one robot; a fleet of robots sends scans alone")
        return self

    @model_validator(mode="after")
    def _refuse_faults(self) -> ResolvedExperiment:
        link = self.link
        goes_round = link.start_s == RANDOM
        ways, is_fleet = (link.uplink, link.downlink), self.is_fleet
        if text := refusal(self.faults, *ways, goes_round=goes_round, is_fleet=is_fleet):
            raise ValueError(text)
        return self

    @property
    def uplink(self) -> DirectionConfig:
        """Conditions of the link from world to cloud."""
        return self._acting("uplink")

    @property
    def downlink(self) -> DirectionConfig:
        """Conditions of the link from cloud to world."""
        return self._acting("downlink")

    def _acting(self, name: str) -> DirectionConfig:
        """Return a direction with its faults; its schedule repeats if it begins at random."""
        way: DirectionConfig = getattr(self.link, name)
        if self.link.start_s == RANDOM:
            return way.model_copy(update={"loop": True}) if way.may_repeat else way
        link = acting(self.faults, *OF_LINK)
        faults = [fault for fault in link if fault.direction in (None, name)]
        return with_faults(way, faults, self.link.start_s or 0.0) if faults else way

    @property
    def network(self) -> str:
        """The link in words, for headlines: the place of cloud, or the link profile."""
        place, profile = self.cloud.place, self.link.profile
        if place is not None and profile == "ideal":
            return f"place {Path(place).stem}"
        return f"link {profile}"

    @property
    def link_values(self) -> dict[str, Any]:
        """Content of a profile of this link with its faults, without defaults."""
        link = self.link
        if acting(self.faults, *OF_LINK):
            link = link.model_copy(update={"uplink": self.uplink, "downlink": self.downlink})
        keys = {*DIRECTIONS, "start_s"}
        return link.model_dump(mode="json", include=keys, exclude_defaults=True)


def bounds_of(files: WorldFiles, *, has_speed: bool = False) -> Bounds:
    """Return what robot and scene of an experiment tell about the limits of the guard.

    If the fence is not known without MuJoCo, it limits nothing, as long as the experiment
    `has_speed`: it gives guard.speed_max_mps.
    """
    scene, room = files.scene, inf
    if scene.own_fence or not has_speed:
        room = fence_of(scene).room(scene.spawn)
    return Bounds(files.robot.guard, room)


def dump(experiment: ResolvedExperiment) -> str:
    """Format an experiment as YAML; loading this YAML returns an equal experiment."""
    return write_yaml(experiment.model_dump(mode="json"))


def fingerprint(experiment: ResolvedExperiment) -> str:
    """Return the SHA-256 of the YAML from `dump`; experiments with equal hashes are equal."""
    return hashlib.sha256(dump(experiment).encode()).hexdigest()


def local_files(value: Any) -> dict[str, str]:
    """Return dotted key -> path of each existing file whose absolute path is in `value`."""
    return {key: path for key, path in absolute_paths(value).items() if Path(path).is_file()}


def absolute_paths(value: Any, key: str = "") -> dict[str, str]:
    """Return dotted key -> each text in `value` that is an absolute path, if only by its form.

    `key` is the dotted key of `value` itself.
    """
    if isinstance(value, str):
        return {key: value} if value.startswith("/") else {}
    listed = dict(enumerate(value)) if isinstance(value, list) else value
    inner = listed.items() if isinstance(listed, dict) else ()
    parts = [absolute_paths(each, f"{key}.{name}".lstrip(".")) for name, each in inner]
    return {where: path for part in parts for where, path in part.items()}
