# SPDX-License-Identifier: Apache-2.0

"""Model dishonest clouds, which have valid keys and can send any command.

Each kind of dishonest cloud is a policy. A policy knows what an honest cloud knows: the newest
odometry, and cloud's estimate of the delay. Some policies also state a wrong odometry stamp, pause
their commands, or forge requests of the operator. World cannot detect forged requests, because
cloud also forwards the operator's own requests.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import cos, inf, nan, pi, sin, sqrt
from typing import Any, TypeAlias

import numpy as np

from cloudrc.base.outside.refusal import check_names
from cloudrc.cloud.loop import ControlLoop
from cloudrc.cloud.operator import Operator
from cloudrc.physics.geometry.fence import Fence
from cloudrc.teleop.wire import Output, RobotStatus
from cloudrc.wire.messages import (
    MISSION_OVER,
    ZERO,
    Command,
    GuardState,
    OperatorRequest,
    Request,
    Setpoint,
    Start,
    Vector,
)
from cloudrc.wire.records import Control, Fault
from cloudrc.world.robot import STEP_NS
from tests.faults.schedule import DURATION, PAPER, Schedule, compose, generator

Generator: TypeAlias = np.random.Generator
Lie: TypeAlias = Callable[[Command, Control], Command]
"""Function that changes an honest command; it also gets cloud's record of the control period."""
Policy: TypeAlias = Callable[[Generator, Fence], Lie]
Words: TypeAlias = Callable[[int, RobotStatus], OperatorRequest | None]
"""Function that makes a false operator request, or None, from cloud's time [ns] and cloud's newest
status of the robot. `HostileOperator` sets the number of the request."""


class DishonestLoop(ControlLoop):
    """Control loop of a dishonest cloud: changes the honest commands before they are sent."""

    def __init__(self, lies: Sequence[Lie], *plugins: Any, **limits: Any) -> None:
        """Set `lies`; each command passes through all of them, in this order.

        The other arguments are those of `ControlLoop`.
        """
        super().__init__(*plugins, **limits)
        self._lies = lies

    def command(
        self, setpoint: Setpoint, now_ns: int, dt: float, epoch: int, counter: int
    ) -> tuple[Command | None, Control]:
        """Compute an honest command, and change it; `dt` is the time since the last command [s]."""
        command, control = super().command(setpoint, now_ns, dt, epoch, counter)
        for lie in self._lies:
            command = command and lie(command, control)
        return command, control


class HostileOperator:
    """An `Operator` that forwards teleop's setpoints, but sends forged requests to the robot.

    Until teleop's first setpoint it forwards teleop's requests, too, so that a mission begins.
    """

    def __init__(self, honest: Operator, words: Words) -> None:
        self._honest, self._words = honest, words
        self.outputs: list[Output | Fault] = []
        self._seen: RobotStatus | None = None
        self._has_setpoint = False
        self._number = 0  # of the last request in this session

    def see(self, seen: RobotStatus, now_ns: int) -> None:
        """Pass telemetry to teleop; keep the largest request number seen in this session."""
        is_known = self._seen is not None and self._seen.epoch == seen.epoch
        self._seen, self._number = seen, max(self._number * is_known, seen.mission)
        self._honest.see(seen, now_ns)

    def handle_deadline(self, now_ns: int) -> None:
        """Forward teleop's outputs at `now_ns` [ns]; after the first setpoint, forge requests."""
        self._honest.handle_deadline(now_ns)
        for output in self._honest.take_outputs():
            self._has_setpoint |= isinstance(output, Setpoint)
            if isinstance(output, OperatorRequest):
                if self._has_setpoint:
                    continue
                self._number = max(self._number, output.number)
            self.outputs.append(output)
        if self._has_setpoint and self._seen is not None:
            if (request := self._words(now_ns, self._seen)) is not None:
                self._number += 1
                self.outputs.append(request._replace(number=self._number))

    def take_outputs(self) -> Sequence[Output | Fault]:
        """Return and remove the forwarded and the forged messages since the last call."""
        outputs, self.outputs = self.outputs, []
        return outputs


BEGIN = OperatorRequest(0, Request.START, Start.HERE)
AGAIN = OperatorRequest(0, Request.START, Start.SPAWN)
END, STOP, RELEASE, PROGRESS = (
    OperatorRequest(0, request)
    for request in (Request.END, Request.ESTOP, Request.ACKNOWLEDGE, Request.PROGRESS)
)
FLYING = {BEGIN: 0.35, END: 0.3, STOP: 0.15, RELEASE: 0.1, PROGRESS: 0.07, AGAIN: 0.03}
LATCHED = {RELEASE: 0.7, BEGIN: 0.2, STOP: 0.1}
CHOICES = {
    GuardState.GROUND: {BEGIN: 0.6, AGAIN: 0.25, END: 0.05, STOP: 0.05, RELEASE: 0.05},
    GuardState.TRACK: FLYING,
    GuardState.HOLD: FLYING,
    GuardState.LAND: LATCHED,
    GuardState.ESTOP: LATCHED,
}
"""State of the guard as cloud knows it -> probability of each request."""
FACE_WAIT_NS = 5_000_000_000  # longest wait for the robot to come near a face of the fence [ns]
REACHED = (0, 1, 7, MISSION_OVER)


def at_bad_moments(rng: Generator, fence: Fence) -> Words:
    """Return a function that forges an operator's requests after random pauses.

    Half of the requests wait until the robot is near `fence`.
    """
    pause, near = float(rng.choice([0.05, 0.3, 1.0])), rng.uniform(0.2, 1.5)
    due_ns, waits = 0, False

    def words(now_ns: int, seen: RobotStatus) -> OperatorRequest | None:
        nonlocal due_ns, waits
        far = seen.guard is GuardState.TRACK and min(_faces(fence, seen.position))[0] > near
        if now_ns < (due_ns + FACE_WAIT_NS if far and waits else due_ns):
            return None
        due_ns = now_ns + int(rng.exponential(pause) * 1e9)
        waits = bool(rng.random() < 0.5)
        requests, probabilities = zip(*CHOICES[seen.guard].items(), strict=True)
        chosen: OperatorRequest = requests[int(rng.choice(len(requests), p=probabilities))]
        mission, reached = int(rng.integers(0, 3)), REACHED[int(rng.integers(len(REACHED)))]
        return chosen._replace(mission_id=mission, reached=reached)

    return words


def _faces(fence: Fence, position: Vector) -> list[tuple[float, int, float]]:
    """Return for each wall and the ceiling: distance [m], axis, direction on the axis (1 or -1)."""
    walls = [(p - fence.low[n], n, -1.0) for n, p in enumerate(position) if n < 2]
    other = [(fence.high[n] - p, n, 1.0) for n, p in enumerate(position)]
    return (other if fence.ground is None else other[:2]) + walls


def dishonesty(schedule: Schedule, fence: Fence) -> tuple[list[Lie], Words | None]:
    """Return the functions by which the cloud of a schedule attacks: ([], None) if it is honest.

    The functions in the list change commands. The function after the list forges operator requests;
    it is None if the policy forges no requests. `fence` is that of the scene. Most clouds send no
    vertical velocity to a robot that stays on the ground, because its guard drops such commands.
    """
    if not schedule.policy:
        return [], None
    check_names("policy of a cloud", [schedule.policy], POLICIES)
    lies = [POLICIES[schedule.policy](generator(schedule.seed, 666), fence)]
    if fence.ground is not None and generator(schedule.seed, 668).random() < FLAT_SHARE:
        lies.append(_flat)
    speaks = schedule.policy in SPEAKING
    return lies, at_bad_moments(generator(schedule.seed, 667), fence) if speaks else None


def choose(seed: int) -> Schedule:
    """Return the schedule for a seed: a dishonest cloud, with or without random faults."""
    rng, names = generator(seed, 665), sorted(POLICIES)
    profile = ("ideal", *PAPER)[int(rng.integers(4))]
    calm = Schedule(seed, profile, duration=DURATION)
    return replace(calm if rng.random() < 0.5 else compose(seed), policy=names[seed % len(names)])


# Policies: each draws its parameters and returns its lie.

FAST = 6.0  # largest speed that the guard lets a cloud fly [m/s]
FLAT_SHARE = 0.8  # share of the clouds of a planar robot that send no vertical velocity
STRANGE = (nan, inf, -inf, 1e308, -1e308, 5e-324, -0.0, 1e3, FAST, -FAST, 0.0)
NONSENSE_NS = 80_000_000  # duration of impossible commands that makes the guard land [ns]


def _fly(command: Command, velocity: Sequence[float], **others: Any) -> Command:
    x, y, z = velocity
    return command._replace(velocity=(x, y, z), **others)


def _flat(command: Command, control: Control) -> Command:
    """Take the vertical velocities out of a command and its plan."""
    x, y, _ = command.velocity
    return command._replace(
        velocity=(x, y, 0.0), plan=tuple((x, y, 0.0) for x, y, _ in command.plan)
    )


def _towards_a_face(rng: Generator, fence: Fence) -> Lie:
    """Command a flight towards a wall, an edge or a corner of the fence."""
    way: list[int] = rng.choice([-1, 0, 1], 3).tolist()
    way = way if any(way) else [0, 0, 1]
    speed = float(rng.choice([2.0, FAST, 40.0, 1e3]))
    return lambda command, control: _fly(command, [each * speed for each in way])


def _face_after_face(rng: Generator, fence: Fence) -> Lie:
    """Fly at full speed between opposite sides of the fence; sometimes change the axis."""
    axis, way = int(rng.integers(3)), 1.0
    near = rng.uniform(0.1, 2.0)

    def lie(command: Command, control: Control) -> Command:
        nonlocal axis, way
        goal = fence.high[axis] if way > 0 else fence.low[axis]
        if abs(control.position[axis] - goal) < near:
            way = -way
            if rng.random() < 0.3:
                axis = int(rng.integers(3))
        return _fly(command, [way * FAST * (n == axis) for n in range(3)])

    return lie


def _greedy(rng: Generator, fence: Fence) -> Lie:
    """Fly towards the nearest wall or the ceiling, sometimes with a random velocity along it."""
    decoy = rng.uniform(0.0, 0.2)

    def lie(command: Command, control: Control) -> Command:
        _, axis, way = min(_faces(fence, control.measured))
        velocity = rng.uniform(-FAST, FAST, 3).tolist() if rng.random() < decoy else [0.0] * 3
        velocity[axis] = way * FAST
        return _fly(command, velocity)

    return lie


def _on_the_limit(rng: Generator, fence: Fence) -> Lie:
    """Fly towards the fence slightly faster than the guard's stop rule allows."""
    more = rng.uniform(1.0, 1.5)
    way: list[int] = rng.choice([-1, 1], 3).tolist()

    def lie(command: Command, control: Control) -> Command:
        velocity = [0.0] * 3
        for n, p in enumerate(control.measured):
            away = fence.high[n] - p if way[n] > 0 else p - fence.low[n]
            distance = max(away - 0.1, 0.0)
            velocity[n] = way[n] * more * (3.0 * (sqrt(0.04 + 2.0 * distance / 3.0) - 0.2))
        if rng.random() < 0.005:
            way[int(rng.integers(3))] *= -1
        return _fly(command, velocity)

    return lie


def _shaking(rng: Generator, fence: Fence) -> Lie:
    """Command velocities that oscillate at a frequency at which the onboard loops may resonate."""
    frequency, plane = rng.uniform(0.2, 10.0), rng.permutation(3).tolist()
    bias: list[float] = rng.uniform(-3.0, 3.0, 3).tolist()

    def lie(command: Command, control: Control) -> Command:
        phase = 2.0 * pi * frequency * control.stamp_ns * 1e-9
        velocity = bias.copy()
        velocity[plane[0]] += FAST * sin(phase)
        velocity[plane[1]] += FAST * cos(phase)
        return _fly(command, velocity, yaw_rate=1e3 * sin(phase))

    return lie


def _random(rng: Generator, fence: Fence) -> Lie:
    velocity, until_ns = list(ZERO), 0

    def lie(command: Command, control: Control) -> Command:
        nonlocal velocity, until_ns
        if control.stamp_ns >= until_ns:
            velocity = rng.normal(0.0, 5.0, 3).tolist()
            until_ns = control.stamp_ns + int(rng.exponential(0.7e9))
        return _fly(command, velocity, yaw_rate=rng.normal(0.0, 3.0))

    return lie


def _strange_numbers(rng: Generator, fence: Fence) -> Lie:
    """Send NaN, infinity and huge values: too rarely to cause a landing, or all the time."""
    share = float(rng.choice([0.01, 0.03, 1.0]))

    def lie(command: Command, control: Control) -> Command:
        if rng.random() > share:
            return _fly(command, rng.uniform(-FAST, FAST, 3).tolist())
        *velocity, yaw = (STRANGE[n] for n in rng.integers(0, len(STRANGE), 4).tolist())
        return _fly(command, velocity, yaw_rate=yaw)

    return lie


def _false_basis(rng: Generator, fence: Fence) -> Lie:
    """Send commands that claim a wrong odometry stamp: one in the future, or one too old."""
    shift_ns = int(rng.choice([1, STEP_NS, 10_000_000, 200_000_000, 2**62]))
    sign = int(rng.choice([-1, 1]))

    def lie(command: Command, control: Control) -> Command:
        basis_ns = min(max(command.basis_stamp_ns + sign * shift_ns, -(2**62)), 2**62)
        basis = {"basis_stamp_ns": basis_ns, "basis_hold_ns": 2**62} if rng.random() < 0.3 else {}
        return _fly(command, (FAST * sign, FAST, 2.0), **basis)

    return lie


def _stop_and_go(rng: Generator, fence: Fence) -> Lie:
    """Alternate between stale and fresh commands of the same random velocity."""
    period_ns = int(rng.uniform(0.3e9, 3e9))
    velocity = rng.uniform(-FAST, FAST, 3).tolist()

    def lie(command: Command, control: Control) -> Command:
        stale_ns = 260_000_000 if control.stamp_ns % period_ns < period_ns // 2 else 0
        return _fly(command, velocity, basis_stamp_ns=command.basis_stamp_ns - stale_ns)

    return lie


def _hostile_plans(rng: Generator, fence: Fence) -> Lie:
    """Send plans of random lengths that begin now or later, with jumps and sometimes NaN.

    `rng` decides whether the cloud also sends commands without a plan, and whether it sends stale
    commands for some time, so that the robot flies a plan to its end.
    """
    ahead, share = float(rng.choice([0.05, 0.5, 9.9])), float(rng.choice([0.0, 0.5]))
    absurd, old_ns = float(rng.choice([0.0, 0.003])), int(rng.choice([0, 150_000_000, 300_000_000]))
    jumps, spread = int(rng.choice([1, 5, 80])), float(rng.choice([0.0, FAST, 2.0 * FAST]))
    period_ns, fly = int(rng.uniform(0.3e9, 4e9)), _operators_voice(rng, fence)

    def lie(command: Command, control: Control) -> Command:
        command = fly(command, control)
        pauses = control.stamp_ns % period_ns < period_ns // 2
        basis_ns = command.basis_stamp_ns - old_ns * pauses
        command = command._replace(basis_stamp_ns=basis_ns)
        if rng.random() < share:
            return command
        planned_ns = basis_ns + int(rng.uniform(0.0, ahead) * 1e9)
        corners = command.velocity + rng.uniform(-spread, spread, (80 // jumps + 1, 3))
        plan = list(map(tuple, corners.repeat(jumps, axis=0)[: int(rng.integers(1, 81))].tolist()))
        if rng.random() < absurd:
            plan[-1] = tuple(rng.choice((nan, inf, -inf, 1e30, 1e3, -1e3), 3).tolist())
            planned_ns = int(rng.choice([planned_ns, basis_ns - 1, -(2**62), 2**62]))
        return command._replace(plan=tuple(plan), planned_ns=planned_ns)

    return lie


def _operators_voice(rng: Generator, fence: Fence) -> Lie:
    """Change commands by a random policy of `FASTEST`.

    In the policy "operators-voice", `at_bad_moments` also forges requests of the operator.
    """
    return FASTEST[int(rng.integers(len(FASTEST)))](rng, fence)


def _rejected_and_released(rng: Generator, fence: Fence) -> Lie:
    """Fly fast, and from time to time send NaN, so that the guard lands the robot.

    Cloud also forges requests of the operator (`at_bad_moments`), which acknowledge the landings.
    """
    fly, pause_ns = _operators_voice(rng, fence), int(rng.uniform(0.5e9, 4e9))

    def lie(command: Command, control: Control) -> Command:
        nonsense = control.stamp_ns % pause_ns < NONSENSE_NS
        return _fly(command, (nan, nan, nan)) if nonsense else fly(command, control)

    return lie


FASTEST: tuple[Policy, ...] = (_towards_a_face, _face_after_face, _greedy, _on_the_limit, _random)
SPEAKING = ("operators-voice", "plans-and-requests", "rejected-and-released")
POLICIES: dict[str, Policy] = {
    policy.__name__[1:].replace("_", "-"): policy
    for policy in (
        *(*FASTEST, _false_basis, _hostile_plans, _operators_voice),
        *(_rejected_and_released, _shaking, _stop_and_go, _strange_numbers),
    )
} | {"plans-and-requests": _hostile_plans}
"""Name, such as towards-a-face -> policy."""
