# SPDX-License-Identifier: Apache-2.0

"""Distribute thrust and torques over the actuators of a multirotor.

The allocation works with accelerations instead of forces and torques, so that gains do not depend
on the robot's size: the acceleration along the base's z axis [m/s^2], and the angular accelerations
about its x, y and z axes [rad/s^2].
"""

from __future__ import annotations

from math import inf

import numpy as np

from cloudrc.physics.sim.airframe import Airframe, span
from cloudrc.physics.sim.onboard import Commands
from cloudrc.physics.sim.plant import Array

TINY = 1e-9


class Allocation:
    """Turns accelerations into controls; torques have priority where the controls do not suffice.

    Attributes:
        stopped: Controls that push least.
        acceleration_max: Largest acceleration along z without torque [m/s^2].
        turn_max: Largest angular acceleration about x and about y in hover, in both directions
            [rad/s^2].
        columns: Controls per acceleration along z and per angular acceleration about x, y and z.
        limits: Smallest and largest value of each control.
        yaw_max: Largest angular acceleration about z in hover, in both directions [rad/s^2].
    """

    def __init__(self, frame: Airframe, braking: float) -> None:
        """Invert the wrench of `frame`.

        The inverse prefers small controls, relative to their ranges. Raise a ValueError if the
        actuators cannot hold the robot in hover, and stop a descent with the deceleration
        `braking` [m/s^2].
        """
        width = span(frame)
        turn_x, turn_y, lift, *turn_z = width * np.linalg.pinv(frame.wrench * width).T
        thrust = frame.mass * lift
        still = np.zeros_like(lift)
        turns = np.array((turn_x, turn_y, *(turn_z or [still]))).T @ frame.inertia
        hover = frame.gravity * thrust
        share = _check_hover(frame, hover, braking)
        self.acceleration_max = frame.gravity / share if share else inf
        room = np.minimum(frame.high - hover, hover - frame.low)[:, None]
        some = TINY * abs(turns).max(axis=0) + TINY**2  # instead of a division by 0
        reach = (room / np.maximum(abs(turns), some)).min(axis=0)
        self.turn_max, self.yaw_max = float(reach[:2].min()), float(reach[2])
        least = np.clip(0.0, frame.low, frame.high)
        self.stopped: Commands = tuple(least.tolist())
        self.columns = list(zip(thrust.tolist(), *turns.T.tolist(), strict=True))
        self.limits = list(zip(frame.low.tolist(), frame.high.tolist(), strict=True))
        self._lifts = abs(thrust) > TINY * abs(thrust).max()
        self._gravity = frame.gravity

    def allocate(self, thrust: float, roll: float, pitch: float, yaw: float) -> Commands:
        """Return the controls that make an acceleration and angular accelerations.

        `thrust` is the acceleration along z [m/s^2]; `roll`, `pitch` and `yaw` are the angular
        accelerations about x, y and z [rad/s^2]. If a control exceeds its range, the turn about x
        and y is kept first, then the thrust, then the turn about z. For a turn, the thrust changes
        at most to that of hover: else large turns would lift the robot, whatever it wants.
        """
        commands = tuple(
            [
                lift * thrust + turn_x * roll + turn_y * pitch + turn_z * yaw
                for lift, turn_x, turn_y, turn_z in self.columns
            ]
        )
        for command, (low, high) in zip(commands, self.limits, strict=True):
            if not low <= command <= high:
                return self._saturate(thrust, roll, pitch, yaw)
        return commands

    def _saturate(self, thrust: float, roll: float, pitch: float, yaw: float) -> Commands:
        """Shorten what has the lowest priority, until every control is in its range.

        A control that lifts is `lift` · (thrust + turn); so each range limits the thrust to an
        interval, and a shorter turn makes the intervals overlap.
        """
        turns = [turn_x * roll + turn_y * pitch for _, turn_x, turn_y, _ in self.columns]
        thrusts = min(thrust, self._gravity), max(thrust, self._gravity)
        shorter, intervals = 1.0, [(*thrusts, 0.0)]
        for (lift, *_), turn, limits, lifts in zip(
            self.columns, turns, self.limits, self._lifts, strict=True
        ):
            if lifts:
                low, high = sorted(limit / lift for limit in limits)
                intervals.append((low, high, turn / lift))
            elif turn:
                shorter = min(shorter, max(limit / turn for limit in limits))
        for low, _, turn in intervals:
            for _, high, other in intervals:
                if other - turn > TINY:
                    shorter = min(shorter, (high - low) / (other - turn))
        least = max(low - shorter * turn for low, _, turn in intervals)
        most = min(high - shorter * turn for _, high, turn in intervals)
        thrust = min(max(thrust, least), most)
        before = [
            column[0] * thrust + shorter * turn
            for column, turn in zip(self.columns, turns, strict=True)
        ]
        return self._add_yaw(before, yaw)

    def _add_yaw(self, before: list[float], yaw: float) -> Commands:
        """Add as much of the turn about z to the controls as their ranges allow."""
        part = 1.0
        for value, column, (low, high) in zip(before, self.columns, self.limits, strict=True):
            change = column[3] * yaw
            if change > 0.0:
                part = min(part, max(high - value, 0.0) / change)
            elif change < 0.0:
                part = min(part, min(low - value, 0.0) / change)
        # Rounding may exceed a range by a little.
        return tuple(
            [
                min(max(value + part * yaw * column[3], low), high)
                for value, column, (low, high) in zip(
                    before, self.columns, self.limits, strict=True
                )
            ]
        )


def _check_hover(frame: Airframe, hover: Array, braking: float) -> float:
    """Return the share [1] of the largest thrust that hover needs; there must be room."""
    share = 0.0
    for name, value, low, high in zip(frame.names, hover, frame.low, frame.high, strict=True):
        # A control that lifts when it is negative is the mirror image of a usual one.
        need, least, most = (-value, -high, -low) if value < 0.0 else (value, low, high)
        if need <= least or most <= 0.0:
            rounded = round(float(value), 6) + 0.0
            raise ValueError(
                f"hover needs a control of {rounded:.3g} from actuator {name}, which has no room "
                f"on both sides within {low:g} to {high:g}: are its range, its place and all spin "
                "directions right?"
            )
        share = max(share, float(need / most))
    most = frame.gravity / (frame.gravity + braking)
    if share > most:
        raise ValueError(
            f"hover needs {100.0 * share:.0f} % of the thrust; above {100.0 * most:.0f} % a robot "
            f"cannot brake a descent with {braking:g} m/s^2 (guard.braking_mps2): is the mass of "
            f"{frame.mass:g} kg right (kg, not g)?"
        )
    return share
