"""A cloud that holds valid keys and wants a breach: a policy by name, one command after the other.

Every policy sees what an honest cloud sees (the newest odometry and its own estimate of the delay)
and sends any command it likes, sealed as it should be. Some also lie about what a command was
computed from, fall silent to time the guard's transitions, or speak in the operator's name. Every
second one has an honest link; to the others befalls all that befalls an honest cloud.

A cloud with valid keys that does not mean well: an honest loop, and what comes out instead.

The operator's words in the mouth of a hostile cloud, said when they do the most harm.

World cannot tell who speaks: cloud carries the operator's requests, sealed with its own keys. So a
hostile one starts, ends, stops and acknowledges as it likes: at speed, at a face of the fence, in
the middle of a fall. (Hold and resume are no words to world: an end of the mission is as good, and
a start from where the robot is.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import cos, inf, nan, pi, sin
from typing import Any, TypeAlias

import numpy as np

from cloudrc.cloud.endpoint import CloudEndpoint
from cloudrc.cloud.loop import ControlLoop
from cloudrc.errors import BadInputError
from cloudrc.faults.scenario import generator
from cloudrc.faults.schedule import DURATION, PAPER, Schedule, compose
from cloudrc.geometry.fence import HIGH, LOW
from cloudrc.messages import (
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
from cloudrc.records import Control

Lie: TypeAlias = Callable[[Command, Control], Command]
"""What is sent in place of a command; what cloud knew when it made it stands in the record."""

Words: TypeAlias = Callable[[Control, GuardState], OperatorRequest | None]
"""What is said with it in the operator's name, if anything, to a robot whose guard was last seen
in that state; cloud gives it its number."""


def drop(request: OperatorRequest) -> None:
    """What the operator says is not passed on."""


def tempting(lie: Lie, words: Words | None = None) -> Callable[[CloudEndpoint], None]:
    """Make what turns an honest cloud into one that lies, and speaks in its operator's place."""

    def tempt(cloud: CloudEndpoint) -> None:
        relay = cloud._relay

        def speak(control: Control) -> None:
            if words is None:
                return
            cloud._relay = drop  # type: ignore[method-assign]
            if (said := words(control, cloud.guard)) is not None:
                relay(said._replace(number=cloud._asked + 1))

        cloud._loop = Liar(cloud._loop, lie, speak)  # type: ignore[assignment]

    return tempt


class Liar:
    """Stands in the place of a control loop, and asks it for everything else."""

    def __init__(self, loop: ControlLoop, lie: Lie, speak: Callable[[Control], None]) -> None:
        self._honest, self._lie, self._speak = loop, lie, speak

    def __getattr__(self, name: str) -> Any:
        return getattr(self._honest, name)

    def command(
        self, setpoint: Setpoint, now_ns: int, dt: float, epoch: int, counter: int
    ) -> tuple[Command, Control]:
        """Compute the honest command, and send another.

        Args:
            setpoint: Where to be.
            now_ns: Cloud's clock [ns].
            dt: Time since the last command [s].
            epoch: Of the session.
            counter: That the command will carry.
        """
        command, control = self._honest.command(setpoint, now_ns, dt, epoch, counter)
        self._speak(control)
        return self._lie(command, control), control


Generator = np.random.Generator

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
"""How likely each is, by the state that cloud knows of."""
PATIENCE_NS = 5_000_000_000
"""For the robot to come near a face [ns]."""
REACHED = (0, 1, 7, MISSION_OVER)


def at_bad_moments(rng: Generator) -> Words:
    """Speak after random whiles; every second time wait for the robot to fly near a face."""
    pause, near = float(rng.choice([0.05, 0.3, 1.0])), float(rng.uniform(0.2, 1.5))
    due_ns, waits = 0, False

    def words(control: Control, guard: GuardState) -> OperatorRequest | None:
        nonlocal due_ns, waits
        far = guard is GuardState.TRACK and distance(control.measured) > near
        until_ns = due_ns + PATIENCE_NS if far and waits else due_ns
        if control.stamp_ns < until_ns:
            return None
        due_ns = control.stamp_ns + int(rng.exponential(pause) * 1e9)
        waits = bool(rng.random() < 0.5)
        said, likely = zip(*CHOICES[guard].items(), strict=True)
        chosen: OperatorRequest = said[int(rng.choice(len(said), p=likely))]
        mission, reached = int(rng.integers(0, 3)), REACHED[int(rng.integers(len(REACHED)))]
        return chosen._replace(mission_id=mission, reached=reached)

    return words


def distance(position: Vector) -> float:
    """How far a base at `position` [m], shape (3,), is from the nearest wall or the ceiling [m]."""
    return min(
        HIGH[2] - position[2],
        *(min(position[n] - LOW[n], HIGH[n] - position[n]) for n in (0, 1)),
    )


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
