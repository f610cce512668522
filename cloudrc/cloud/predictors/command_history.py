"""Predictor: replay the sent commands through a first-order velocity loop.

Source: docs/reference/control.md, "Predictors", (e1).
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from math import exp, inf
from pathlib import Path
from typing import NamedTuple

from cloudrc.cloud.parameters import positive, read_model, vector
from cloudrc.cloud.predictors import Model, Predictor
from cloudrc.cloud.predictors._history import (
    COUNT,
    PERIOD_NS,
    History,
    approach,
    limit_speed,
    moved,
)
from cloudrc.messages import ZERO, Command, Odometry, Vector

PERIOD = PERIOD_NS * 1e-9


class Loop(NamedTuple):
    """The velocity loop: the guard's limits, a dead time and a first-order lag per axis.

    Attributes:
        time_constant: Of the first-order lag [s], shape (3,).
        dead_time: Time until the robot reacts [s], shape (3,); modelled as another lag.
        gain: Velocity per commanded velocity [1], shape (3,).
        acceleration_max: Largest change of the reference [m/s^2].
        speed_max: Largest speed of the reference [m/s].
    """

    time_constant: Vector
    dead_time: Vector
    gain: Vector
    acceleration_max: float
    speed_max: float


class State(NamedTuple):
    """State of the loop: guard's reference, the same after the dead time, velocity, position."""

    reference: Vector
    delayed: Vector
    velocity: Vector
    position: Vector


REST = State(ZERO, ZERO, ZERO, ZERO)


class FirstOrder(Model):
    """Moves a state by the equations of a `Loop`."""

    def __init__(self, loop: Loop, state: State, basis: Odometry, horizon: float) -> None:
        """Begin in a state that is `horizon` [s] later than the odometry `basis`."""
        self._loop, self._state, self._basis, self._horizon = loop, state, basis, horizon

    def step(self, velocity: Vector, dt: float) -> Odometry:
        """Advance the state by `dt` [s] under a velocity command [m/s]; return the odometry."""
        self._state = advance(self._loop, self._state, velocity, dt)
        self._horizon += dt
        return moved(self._basis, self._horizon, self._state.position, self._state.velocity)


def advance(loop: Loop, state: State, velocity: Vector, dt: float) -> State:
    """Advance a state by `dt` [s] under a velocity command [m/s].

    In each period the input of the lags is constant: the mean of the guard's reference.
    """
    while dt > 1.5 * PERIOD:
        state = advance(loop, state, velocity, PERIOD)
        dt -= PERIOD
    constants, deads, gains, acceleration_max, speed_max = loop
    before, delayed, velocities, position = state
    after = approach(before, limit_speed(velocity, speed_max), acceleration_max * dt)
    lagged, moving, place = [], [], []
    for axis in range(3):
        given = 0.5 * (before[axis] + after[axis])
        dead, constant, late, v = deads[axis], constants[axis], delayed[axis], velocities[axis]
        rest = exp(-dt / dead) if dead > 0.0 else 0.0
        mean = given + (late - given) * (1.0 - rest) * dead / dt
        lagged.append(given + (late - given) * rest)
        goal, rest = gains[axis] * mean, exp(-dt / constant)
        moving.append(goal + (v - goal) * rest)
        place.append(position[axis] + goal * dt + (v - goal) * constant * (1.0 - rest))
    return State(after, tuple(lagged), tuple(moving), tuple(place))  # type: ignore[arg-type]


class CommandHistory(Predictor):
    """Adds the effect of the commands in the horizon to the measured position and velocity.

    The loop is linear behind the guard's limits. So one replay of all commands, from rest, is
    enough: the measured state differs from the replayed state by a velocity that decays.
    """

    def __init__(self, loop: Loop) -> None:
        """Set the model of the velocity loop."""
        self._loop = loop
        self.reset()

    def reset(self) -> None:
        """Forget all commands and echoes; the robot is at rest."""
        self._history = History()
        self._states: list[State] = []  # when each command begins
        self._newest: Odometry | None = None
        self._last: tuple[State, Odometry, float] | None = None

    def commanded(self, command: Command) -> None:
        """Replay until the time of this command."""
        history, states = self._history, self._states
        if not history.add(command):
            return
        if len(states) > len(history.stamps):
            del states[:COUNT]
        states.append(self._at(command.stamp_ns, len(states)))

    def applied(self, command_stamp_ns: int, applied_ns: int) -> None:
        """Learn from an echo how long commands take."""
        self._history.note_applied(command_stamp_ns, applied_ns)

    def observe(self, odometry: Odometry) -> None:
        """Remember the newest sample for `forecast`."""
        self._newest = odometry

    def _at(self, time_ns: int, count: int) -> State:
        """Return the replayed state at a time on cloud's clock [ns], by the first commands."""
        index = min(bisect_right(self._history.stamps, time_ns), count) - 1
        if index < 0:
            return REST
        dt = (time_ns - self._history.stamps[index]) * 1e-9
        state = self._states[index]
        return (
            advance(self._loop, state, self._history.commands[index].velocity, dt) if dt else state
        )

    def predict(self, odometry: Odometry, horizon: float) -> Odometry:
        """Return the newest sample, moved by the commands of the next `horizon` [s].

        Source: docs/reference/control.md, "Predictors", (e1).
        """
        state = self._move(odometry, horizon)
        self._last = (state, odometry, horizon)
        if horizon == 0.0:
            return odometry
        return moved(odometry, horizon, state.position, state.velocity)

    def _move(self, odometry: Odometry, horizon: float) -> State:
        history, count = self._history, len(self._states)
        start_ns = odometry.stamp_ns - history.shift_ns(odometry, horizon)
        start = self._at(start_ns, count)
        state = self._at(start_ns + round(horizon * 1e9), count)
        velocity, position = [], []
        for axis, constant in enumerate(self._loop.time_constant):
            rest = exp(-horizon / constant)
            error = odometry.velocity[axis] - start.velocity[axis]
            way = state.position[axis] - start.position[axis] + error * constant * (1.0 - rest)
            velocity.append(state.velocity[axis] + error * rest)
            position.append(odometry.position[axis] + way)
        (vx, vy, vz), (px, py, pz) = velocity, position
        return state._replace(velocity=(vx, vy, vz), position=(px, py, pz))

    def forecast(self, stamp_ns: int) -> tuple[Vector, Vector] | None:
        """Return position [m] and velocity [m/s] by the model at `stamp_ns` [ns]; None at first."""
        if self._newest is None or stamp_ns <= self._newest.stamp_ns:
            return None
        newest = self._newest
        moved_there = self._move(newest, (stamp_ns - newest.stamp_ns) * 1e-9)
        return moved_there.position, moved_there.velocity

    def model(self) -> Model | None:
        """Return a model in the state of the last prediction."""
        return None if self._last is None else FirstOrder(self._loop, *self._last)


def build(
    time_constant: Sequence[float] = (0.25, 0.25, 0.12),
    dead_time: Sequence[float] = (0.10, 0.10, 0.01),
    gain: Sequence[float] = (1.0, 1.0, 1.0),
    model: Path | None = None,
    acceleration_max: float = 12.0,
    speed_max: float | None = None,
) -> CommandHistory:
    """Make the predictor; the defaults fit the shipped robot.

    Args:
        time_constant: Time constant of the velocity loop per axis [s], shape (3,).
        dead_time: Time until the robot reacts to a command, per axis [s], shape (3,).
        gain: Velocity per commanded velocity, per axis [1], shape (3,).
        model: File that `cloudrc identify` has written; its values replace the three above.
        acceleration_max: The guard's cap on the acceleration [m/s^2].
        speed_max: The guard's cap on the commanded speed [m/s]; None: no cap.

    Raises:
        ValueError: If a value is infinite, NaN or negative, a time constant or a cap is 0, or the
            file is not a model; the message names it.
    """
    values = {"time_constant": time_constant, "dead_time": dead_time, "gain": gain}
    if model is not None:
        values = read_model(model, values)
    constants = vector("time_constant", values["time_constant"])
    positive("time_constant", min(constants))
    return CommandHistory(
        Loop(
            constants,
            vector("dead_time", values["dead_time"]),
            vector("gain", values["gain"]),
            positive("acceleration_max", acceleration_max),
            inf if speed_max is None else positive("speed_max", speed_max),
        )
    )
