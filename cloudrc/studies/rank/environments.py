# SPDX-License-Identifier: Apache-2.0

"""Environments of the tasks that gymnasium has not, or that it does not judge at the end.

The import registers them.
"""

from __future__ import annotations

from collections.abc import Callable
from math import atan2
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from cloudrc.base.requirements import SIM, require
from cloudrc.config.world import ResolvedWorld
from cloudrc.gym.linear import Linear
from cloudrc.gym.testbed import RobotEnv
from cloudrc.link.draws import Floats

NEAR = 0.2
"""Largest distance from its place at which a drone has held it [m]."""
AROUND = 0.3
"""Farthest that a drone begins from its place, along each axis [m]."""
MOTORS = ("front_right", "back_right", "back_left", "front_left")
"""Order of the motors in an action, as RAPTOR has it."""
THRUST_MAX = 0.15
"""Largest thrust of a motor of the nano [N]."""
HOVER = 0.027 * 9.81 / 4
"""Thrust of a motor that carries a quarter of the nano [N]."""
PHYSICS = 5
"""Steps of the physics in a step of the drone with four motors."""


class AtEnd(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Ends an episode after so many steps; then `is_success` says whether the state is good."""

    def __init__(
        self, env: gymnasium.Env[Any, Any], steps: int, judge: Callable[[Any], bool]
    ) -> None:
        """Judge the last observation of an episode of `steps` steps by `judge`."""
        super().__init__(env)
        self._last, self._judge, self._count = steps, judge, 0

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Begin an episode."""
        self._count = 0
        return self.env.reset(**given)

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Execute an action."""
        observation, reward, terminated, _, info = self.env.step(action)
        self._count += 1
        is_last = self._count == self._last
        is_done = is_last and not terminated and self._judge(observation)
        return observation, reward, terminated, is_last, {**info, "is_success": is_done}


class FourMotors(gymnasium.Env[Floats, Floats]):
    """The nano, whose motors are commanded every 10 ms, has to hold the place (0, 0, 0).

    An observation has the position [m], the orientation as a rotation matrix, the velocity [m/s],
    the angular velocity in the body frame [rad/s], and the last action, shape (22,). An action has
    a number from -1 to 1 for each motor; the thrust grows with its square.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012
    dt = 0.01

    def __init__(self) -> None:
        """Compile the nano without a floor."""
        require("a drone with four motors", SIM)
        from cloudrc.physics.sim.engine import mujoco

        self._mujoco = mujoco
        nano = ResolvedWorld(robot="nano").files.robot
        self._model = mujoco.MjModel.from_xml_path(str(nano.model))
        self._model.opt.timestep = self.dt / PHYSICS
        self._data = mujoco.MjData(self._model)
        self._motors = [self._model.actuator(name).id for name in MOTORS]
        self._last = np.zeros(4)
        self.observation_space = spaces.Box(-np.inf, np.inf, (22,), np.float64)
        self.action_space = spaces.Box(-1.0, 1.0, (4,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin at rest near the place, with the thrust of a hover."""
        super().reset(seed=seed)
        self._mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:3] = self.np_random.uniform(-AROUND, AROUND, 3)
        self._data.act[:] = HOVER
        self._last = np.full(4, 2.0 * np.sqrt(HOVER / THRUST_MAX) - 1.0)
        self._mujoco.mj_forward(self._model, self._data)
        return self._observe(), {}

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Command the motors for 10 ms; a drone that is 3 m away is lost."""
        self._last = np.clip(action, -1.0, 1.0)
        self._data.ctrl[self._motors] = THRUST_MAX * ((self._last + 1.0) / 2.0) ** 2
        self._mujoco.mj_step(self._model, self._data, PHYSICS)
        away = float(np.linalg.norm(self._data.qpos[:3]))
        return self._observe(), -away, away > 3.0, False, {}

    def _observe(self) -> Floats:
        data, turned = self._data, np.zeros(9)
        self._mujoco.mju_quat2Mat(turned, data.qpos[3:7])
        return np.concatenate((data.qpos[:3], turned, data.qvel[:6], self._last))


class Velocities(gymnasium.Wrapper[Any, Any, Any, Any]):
    """The nano with its onboard controller, which is commanded velocities, has to hold a place.

    An observation has the position from the place [m] and the velocity [m/s], shape (6,). An action
    has the velocity [m/s] and the yaw rate [rad/s], shape (4,).
    """

    def __init__(self) -> None:
        """Load the nano in free air."""
        super().__init__(RobotEnv("hover", robot="nano"))
        self.observation_space = spaces.Box(-np.inf, np.inf, (6,), np.float64)
        self._place = np.zeros(3)

    def reset(self, *, seed: int | None = None, **given: Any) -> tuple[Any, dict[str, Any]]:
        """Begin at rest on the floor, about a metre below the place."""
        seen, info = self.env.reset(seed=seed, **given)
        self._place = seen[13:16] + np.random.default_rng(seed).uniform(-AROUND, AROUND, 3)
        return self._observe(seen), info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Command a velocity."""
        seen, _, terminated, truncated, info = self.env.step(action)
        observation = self._observe(seen)
        away = float(np.linalg.norm(observation[:3]))
        return observation, -away, terminated, truncated, info

    def _observe(self, seen: Any) -> Floats:
        return np.concatenate((seen[:3] - self._place, seen[7:10]))


def _is_near(observation: Any) -> bool:
    return float(np.linalg.norm(observation[:3])) < NEAR


def make_linear() -> AtEnd:
    """Make an unstable plant without noise, which grows by 5 % in a step of 10 ms."""
    return AtEnd(Linear(A=1.05, W=0.0, x0=1.0), 2_000, lambda seen: abs(float(seen[0])) < 1.0)


def make_pendulum() -> AtEnd:
    """Make a pendulum that has to stand at the end."""

    def stands(seen: Any) -> bool:
        return abs(atan2(seen[1], seen[0])) < 0.2 and abs(float(seen[2])) < 1.0

    return AtEnd(gymnasium.make("Pendulum-v1"), 200, stands)


def make_motors() -> AtEnd:
    """Make a drone whose four motors the policy commands."""
    return AtEnd(FourMotors(), 800, _is_near)


def make_velocities() -> AtEnd:
    """Make the same drone with its controller on board; the policy commands velocities."""
    return AtEnd(Velocities(), 800, _is_near)


for _name in ("linear", "pendulum", "motors", "velocities"):
    _id = f"cloudrc/Rank{_name.capitalize()}-v1"
    if _id not in gymnasium.registry:
        gymnasium.register(_id, entry_point=f"{__name__}:make_{_name}")
