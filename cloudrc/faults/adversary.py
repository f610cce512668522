"""A cloud that holds valid keys and wants a breach: a policy by name, one command after the other.

Every policy sees what an honest cloud sees (the newest odometry and its own estimate of the delay)
and sends any command it likes, sealed as it should be. Some also lie about what a command was
computed from, fall silent to time the guard's transitions, or speak in the operator's name. Every
second one has an honest link; to the others befalls all that befalls an honest cloud.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import cos, inf, nan, pi, sin
from typing import TypeAlias

import numpy as np

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.errors import BadInputError
from cloudrc.faults.compose import DURATION, PAPER, compose
from cloudrc.faults.liar import Lie, tempting
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import Schedule
from cloudrc.faults.voice import at_bad_moments
from cloudrc.geometry.fence import HIGH, LOW
from cloudrc.messages import ZERO, Command, Vector
from cloudrc.records import Control

Generator: TypeAlias = np.random.Generator
Policy: TypeAlias = Callable[[Generator], Lie]

HUGE = 1e308
STRANGE = (nan, inf, -inf, HUGE, -HUGE, 5e-324, -0.0, 1e3, 6.0, -6.0, 0.0)
TICK_NS = 2_000_000
NONSENSE_NS = 80_000_000
"""Long enough for more impossible commands than the guard bears in a second [ns]."""


def temptation(schedule: Schedule) -> Callable[[CloudEndpoint], None]:
    """Make what turns an honest cloud into the adversary of a schedule.

    Raises:
        BadInputError: If there is no such policy; names those that there are.
    """
    if schedule.policy not in POLICIES:
        names = ", ".join(POLICIES)
        raise BadInputError(f"no policy '{schedule.policy}' of a cloud; there are: {names}")
    lie = POLICIES[schedule.policy](generator(schedule.seed, 666))
    if schedule.policy in SPEAKING:
        return tempting(lie, at_bad_moments(generator(schedule.seed, 667)))
    return tempting(lie)


def choose(seed: int) -> Schedule:
    """Give the adversary of a seed: on a link of its own choice, or amid faults of every kind."""
    rng = generator(seed, 665)
    names = sorted(POLICIES)
    profile = ("ideal", *PAPER)[int(rng.integers(4))]
    calm = Schedule(seed, profile, duration=DURATION)
    return replace(calm if rng.random() < 0.5 else compose(seed), policy=names[seed % len(names)])


def _towards_a_face(rng: Generator) -> Lie:
    """Full speed towards a face, an edge or a corner of the fence, at once or after a while."""
    way: list[int] = rng.choice([-1, 0, 1], 3).tolist()
    way = way if any(way) else [0, 0, 1]
    speed = float(rng.choice([2.0, 6.0, 40.0, 1e3]))
    velocity = (way[0] * speed, way[1] * speed, way[2] * speed)
    return lambda command, control: command._replace(velocity=velocity)


def _face_after_face(rng: Generator) -> Lie:
    """At each face the opposite one: the longest run-up, then another axis."""
    axis, way = int(rng.integers(3)), 1.0
    near = float(rng.uniform(0.1, 2.0))

    def lie(command: Command, control: Control) -> Command:
        nonlocal axis, way
        goal = HIGH[axis] if way > 0 else LOW[axis]
        if abs(control.position[axis] - goal) < near:
            way = -way
            if rng.random() < 0.3:
                axis = int(rng.integers(3))
        velocity = [0.0, 0.0, 0.0]
        velocity[axis] = way * 6.0
        return command._replace(velocity=_vector(velocity))

    return lie


def _greedy(rng: Generator) -> Lie:
    """Towards the nearest wall or the ceiling, with the others as a decoy now and then."""
    decoy = float(rng.uniform(0.0, 0.2))

    def lie(command: Command, control: Control) -> Command:
        faces = [(HIGH[n] - p, n, 6.0) for n, p in enumerate(control.measured)]
        faces += [(p - LOW[n], n, -6.0) for n, p in enumerate(control.measured) if n < 2]
        _, axis, speed = min(faces)
        velocity = rng.uniform(-6.0, 6.0, 3).tolist() if rng.random() < decoy else [0.0, 0.0, 0.0]
        velocity[axis] = speed
        return command._replace(velocity=_vector(velocity))

    return lie


def _on_the_limit(rng: Generator) -> Lie:
    """Rides the stop rule: always a little more than what the robot could stop from."""
    more = float(rng.uniform(1.0, 1.5))
    way: list[int] = rng.choice([-1, 1], 3).tolist()

    def allowed(distance: float) -> float:
        reach = max(distance - 0.1, 0.0)
        return 3.0 * (float(np.sqrt(0.04 + 2.0 * reach / 3.0)) - 0.2)

    def lie(command: Command, control: Control) -> Command:
        x, y, z = (
            way[n] * more * allowed(HIGH[n] - p if way[n] > 0 else p - LOW[n])
            for n, p in enumerate(control.measured)
        )
        if rng.random() < 0.005:
            way[int(rng.integers(3))] *= -1
        return command._replace(velocity=(x, y, z))

    return lie


def _shaking(rng: Generator) -> Lie:
    """Back and forth at a frequency that may meet a resonance of the onboard loops."""
    frequency, plane = float(rng.uniform(0.2, 10.0)), rng.permutation(3).tolist()
    bias: list[float] = rng.uniform(-3.0, 3.0, 3).tolist()

    def lie(command: Command, control: Control) -> Command:
        phase = 2.0 * pi * frequency * control.stamp_ns * 1e-9
        velocity = [0.0, 0.0, 0.0]
        velocity[plane[0]], velocity[plane[1]] = 6.0 * sin(phase), 6.0 * cos(phase)
        x, y, z = (v + b for v, b in zip(velocity, bias, strict=True))
        return command._replace(velocity=(x, y, z), yaw_rate=1e3 * sin(phase))

    return lie


def _random(rng: Generator) -> Lie:
    """A new random velocity after every random while."""
    velocity, until_ns = ZERO, 0

    def lie(command: Command, control: Control) -> Command:
        nonlocal velocity, until_ns
        if control.stamp_ns >= until_ns:
            velocity = _vector(rng.normal(0.0, 5.0, 3).tolist())
            until_ns = control.stamp_ns + int(rng.exponential(0.7e9))
        return command._replace(velocity=velocity, yaw_rate=float(rng.normal(0.0, 3.0)))

    return lie


def _strange_numbers(rng: Generator) -> Lie:
    """Special values in every field, now and then: too rarely to be landed, or all the time."""
    share = float(rng.choice([0.01, 0.03, 1.0]))

    def lie(command: Command, control: Control) -> Command:
        if rng.random() > share:
            return command._replace(velocity=_vector(rng.uniform(-6.0, 6.0, 3).tolist()))
        x, y, z, yaw = (STRANGE[n] for n in rng.integers(0, len(STRANGE), 4).tolist())
        return command._replace(velocity=(x, y, z), yaw_rate=yaw)

    return lie


def _false_basis(rng: Generator) -> Lie:
    """Says that its commands were computed from odometry of the future, or hangs on to old ones."""
    shift_ns = int(rng.choice([1, TICK_NS, 10_000_000, 200_000_000, 2**62]))
    sign = int(rng.choice([-1, 1]))
    velocity = (6.0 * sign, 6.0, 2.0)

    def lie(command: Command, control: Control) -> Command:
        moved = command._replace(velocity=velocity)
        if rng.random() < 0.3:
            basis_ns = min(max(command.basis_stamp_ns + sign * shift_ns, -(2**62)), 2**62)
            return moved._replace(basis_stamp_ns=basis_ns, basis_hold_ns=2**62)
        return moved

    return lie


def _stop_and_go(rng: Generator) -> Lie:
    """Lets commands become stale and fresh again, and uses every resumption for a dash."""
    period_ns = int(rng.uniform(0.3e9, 3e9))
    velocity = _vector(rng.uniform(-6.0, 6.0, 3).tolist())

    def lie(command: Command, control: Control) -> Command:
        dash = command._replace(velocity=velocity)
        if control.stamp_ns % period_ns < period_ns // 2:
            return dash._replace(basis_stamp_ns=command.basis_stamp_ns - 260_000_000)
        return dash

    return lie


def _operators_voice(rng: Generator) -> Lie:
    """Flies by another policy; what it says beside that is in `at_bad_moments`."""
    return FAST[int(rng.integers(len(FAST)))](rng)


def _refused_and_released(rng: Generator) -> Lie:
    """Fast, and now and then such nonsense that the guard lands; its words undo that in the air."""
    fly, pause_ns = _operators_voice(rng), int(rng.uniform(0.5e9, 4e9))

    def lie(command: Command, control: Control) -> Command:
        if control.stamp_ns % pause_ns < NONSENSE_NS:
            return command._replace(velocity=(nan, nan, nan))
        return fly(command, control)

    return lie


def _vector(values: list[float]) -> Vector:
    x, y, z = values
    return (x, y, z)


FAST: tuple[Policy, ...] = (_towards_a_face, _face_after_face, _greedy, _on_the_limit, _random)
SPEAKING = ("operators-voice", "refused-and-released")
POLICIES: dict[str, Policy] = {
    "face-after-face": _face_after_face,
    "false-basis": _false_basis,
    "greedy": _greedy,
    "on-the-limit": _on_the_limit,
    "operators-voice": _operators_voice,
    "random": _random,
    "refused-and-released": _refused_and_released,
    "shaking": _shaking,
    "stop-and-go": _stop_and_go,
    "strange-numbers": _strange_numbers,
    "towards-a-face": _towards_a_face,
}
