"""Find a robot's own sensors, those of its `robot.yaml`, in its compiled model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from cloudrc.config.robot import SensorConfig
from cloudrc.errors import BadInputError
from cloudrc.geometry.compiled import mujoco
from cloudrc.text import unknown_name_text
from cloudrc.world.scene import ROBOT_PREFIX


class OwnSensor(NamedTuple):
    """A sensor of the robot, which shows one number."""

    name: str  # in `robot.yaml`
    unit: str  # of its value
    address: int  # index of its value in MuJoCo's `sensordata`


def find_sensors(model: Any, asked: Mapping[str, SensorConfig]) -> tuple[OwnSensor, ...]:
    """Return the sensors that `robot.yaml` names, in its order.

    `model` is the compiled `MjModel` of robot and scene.

    Raises:
        BadInputError: If the robot has no such sensor, or if the sensor shows several numbers.
    """
    return tuple(
        OwnSensor(name, each.unit, _address(model, f"sensors.{name}.sensor", each.sensor))
        for name, each in asked.items()
    )


def _address(model: Any, key: str, name: str) -> int:
    number = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, f"{ROBOT_PREFIX}{name}")
    if number < 0:
        single = np.flatnonzero(model.sensor_dim == 1)
        names = (model.sensor(each).name for each in single)
        own = [each.removeprefix(ROBOT_PREFIX) for each in names if each.startswith(ROBOT_PREFIX)]
        text = unknown_name_text("scalar sensor of the model", name, sorted(own))
        raise BadInputError(f"{key}: {text}")
    if (count := int(model.sensor_dim[number])) != 1:
        raise BadInputError(
            f"{key}: {name} shows {count} numbers; name a sensor of the model that shows one"
        )
    return int(model.sensor_adr[number])


def find_force(model: Any, site: int) -> int | None:
    """Return where a touch sensor at a site of the model writes; None if there is none."""
    at_site = (model.sensor_type == mujoco.mjtSensor.mjSENS_TOUCH) & (model.sensor_objid == site)
    found = np.flatnonzero(at_site)
    return int(model.sensor_adr[found[0]]) if len(found) else None
