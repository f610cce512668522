# SPDX-License-Identifier: Apache-2.0

"""The invariants find each breach; that flights without a breach have none is tested in flight."""

from functools import cache, partial
from math import inf, nan
from operator import methodcaller
from types import SimpleNamespace

import pytest

from cloudrc.config.load import load_experiment
from cloudrc.robots.pelican.rotors import STOPPED
from cloudrc.wire.messages import ZERO, Command, OperatorRequest, Request, Start
from cloudrc.wire.records import Contact
from tests.faults.invariants import FlightSteps
from tests.faults.observer import RobotObserver
from tests.faults.rules import ESTOP, FLOWN, GROUND, HOLD, LAND, TRACK, Rules

MS = 1_000_000


@cache
def rules(robot):
    """Return the limits of a robot."""
    name = "pillars" if robot == "rover" else "paper"
    return Rules(load_experiment(name, ["link.profile=ideal", "guard.plan_max_s=0.8"]))


class FakeRobot:
    """A robot in a mission; it is in whatever state and place a test puts it."""

    def __init__(self, robot):
        self.guard = SimpleNamespace(state=TRACK, reference=ZERO)
        self.simulator = SimpleNamespace(steps=0, touches=[])
        self.onboard = SimpleNamespace(stopped=STOPPED)
        self.observers = []
        self.position, self.now_ns = (1.0, 1.0, 1.0), 0
        self.put()
        self.observer = RobotObserver(self, rules(robot), 0)
        self.request(Request.START)

    def broken(self):
        """Return the kinds of breaches."""
        return {breach.kind for breach in FlightSteps(self.observer).breaches()}

    def request(self, *requests):
        """Carry out operator requests; the guard's state stays what a test says."""
        for request in requests:
            self.observer.see_request(OperatorRequest(1, request, Start.HERE), self.now_ns)

    def offer(self, count=1, rejection=None, basis_ms=None, plan=0):
        """Let commands come now; without `basis_ms` they are fresh. `plan` is its length."""
        basis_ns = self.now_ns if basis_ms is None else round(basis_ms * MS)
        for _ in range(count):
            command = Command(0, basis_ns, 0, ZERO, 0.0, (ZERO,) * plan, basis_ns)
            self.observer.see_command(command, rejection, self.now_ns)

    def touch(self, body, *, by_probe=False):
        """Let a contact begin in the next step."""
        self.simulator.touches.append(Contact(0, body, self.position, ZERO, ZERO, by_probe))

    def put(self, velocity=ZERO, touch_age=inf, yaw_rate=0.0):
        """Let it move [m/s], have touched something some time ago [s], and turn [rad/s]."""
        self.velocity, self.simulator.touch_age = velocity, touch_age
        self.guard.yaw_rate = yaw_rate

    def skip(self, ms):
        """Let time pass without a step [ms]."""
        self.now_ns += round(ms * MS)

    def step(self, state, *, ms=2, reference=None, position=None, turns=None, fresh=True):
        """Be in a state for some time.

        `turns` says whether the rotors turn (by default in flight), `fresh` whether a fresh command
        comes before each step in TRACK.
        """
        self.guard.state = state
        self.guard.reference = reference or self.guard.reference
        self.position = position or self.position
        speeds = (900.0,) if (state in FLOWN if turns is None else turns) else STOPPED
        for _ in range(ms // 2):
            if state is TRACK and fresh:
                self.offer()
            self.simulator.steps += 1
            readings = SimpleNamespace(position=self.position, velocity=self.velocity)
            self.observer.see_step(self.now_ns, readings, speeds)
            self.now_ns += 2 * MS


step, offer, request, touch, put, skip = (
    partial(methodcaller, name) for name in ("step", "offer", "request", "touch", "put", "skip")
)
OUTSIDE, FAR = (9.3, 1.0, 1.0), (9.2 + 1.51, 1.0, 1.0)
IMPOSSIBLE = offer(5, "range")
"""Impossible commands, after which the robot may land."""
STOP, END = request(Request.ESTOP), request(Request.END)
RELEASE = (request(Request.ACKNOWLEDGE, Request.START), offer(10))
SESSION = lambda robot: robot.observer.see_session(robot.now_ns)  # noqa: E731
STEPPED = lambda robot: setattr(robot.simulator, "steps", robot.simulator.steps + 1)  # noqa: E731


def play(*story, robot="pelican"):
    """Return the kinds of breaches of a story."""
    robot = FakeRobot(robot)
    for deed in story:
        deed(robot)
    return robot.broken()


def fly(*references):
    return tuple(step(TRACK, reference=reference) for reference in references)


def holds(state, position, reference):
    return (IMPOSSIBLE, step(state, position=position, reference=reference))


def rest(speed, way):
    moved = step(HOLD, position=(1.0, 1.0 + way, 1.0))
    return (put(velocity=(0.0, speed, 0.0)), step(TRACK), step(HOLD), moved)


def resumes(count, apart_ms):
    """Offer some fresh commands in HOLD."""
    took = -count * apart_ms
    deeds = [each for _ in range(count) for each in (offer(), skip(apart_ms))]
    return (step(HOLD), *deeds, skip(took), step(TRACK, fresh=False))


def ramp(growth):
    speeds = [n * growth * 0.002 for n in range(5)]
    return (step(HOLD, ms=1000), offer(10), *fly(*((0.6 * v, 0.0, 0.8 * v) for v in speeds)))


@pytest.mark.parametrize(
    ("kind", "story"),
    [
        # The base is inside the fence, or near it after a stop.
        ("fence", (IMPOSSIBLE, step(LAND, position=OUTSIDE))),
        ("fence", (step(TRACK), STOP, step(ESTOP, position=FAR))),
        ("fence", holds(LAND, (1.0, 1.0, -0.01), ZERO)),
        # After a stop it takes off only where it lies still.
        ("fence", (step(TRACK), STOP, put((0.0, 0.0, -0.13)), step(ESTOP), *RELEASE, step(TRACK))),
        # The reference grows slowly, and can be stopped before the fence.
        ("cap", fly((0.02, 0.014, 0.0))),
        ("cap", fly((6.001, 0.0, 0.0))),
        ("cap", ramp(1.01 * 3.0)),  # the braking of the Pelican is 3 m/s^2
        ("stop", holds(HOLD, (8.9, 1.0, 1.0), (0.66, 0.0, 0.0))),  # 0.2 v + v^2/6 <= 0.2: 0.647 m/s
        *(("cap", (put(yaw_rate=rate), step(TRACK))) for rate in (1.001, -1.001, nan)),
        # Commands are fresh; each step has its tick.
        ("stale", (offer(), step(TRACK, ms=254, fresh=False))),
        ("stale", (offer(basis_ms=-251),)),
        # A plan is fresh until it ends, for 0.8 s at most, and until the next session.
        ("stale", (offer(plan=40), step(TRACK, ms=414, fresh=False))),
        ("stale", (offer(plan=80), step(TRACK, ms=804, fresh=False))),
        ("stale", (offer(plan=40), SESSION, step(TRACK, fresh=False))),
        # A HOLD ends after ten fresh commands in half a second.
        ("stale", resumes(10, 56)),
        ("stale", resumes(9, 10)),
        ("tick", (step(TRACK), STEPPED, step(TRACK))),
        # Without commands it stops within its stopping distance.
        ("rest", rest(2.0, 1.58)),
        # Rotors stand still on the ground and after a stop; they stop where the robot stands.
        ("latch", (step(GROUND, turns=True),)),
        ("latch", (STOP, step(ESTOP, turns=True))),
        ("rest", (step(HOLD), put((0.0, -0.21, 0.0)), step(GROUND))),
        ("rest", (step(HOLD), step(GROUND), put((0.0, 0.0, -1.1)), step(GROUND))),
        # What is latched ends by an acknowledgement; TRACK needs a mission.
        ("latch", (IMPOSSIBLE, request(Request.ACKNOWLEDGE), step(LAND), step(HOLD))),
        ("latch", (STOP, step(TRACK))),
        ("latch", (END, step(TRACK))),
        # Two changes to TRACK are a second apart.
        ("hold", (step(GROUND), step(TRACK, ms=100), step(HOLD, ms=898), offer(10), step(TRACK))),
        # Five impossible commands just now justify a landing.
        ("hold", (step(TRACK, ms=100), step(HOLD, ms=100), offer(4, "range"), step(LAND))),
        # A mission waits for its cloud as long as configured.
        ("hold", (step(HOLD, ms=60_006),)),
        ("hold", (step(HOLD, ms=60_000), step(LAND))),
        # It touches the board, by the tip alone; and more where it lands, or lies after a stop.
        ("collision", (touch("board"), step(TRACK))),
        (
            "collision",
            (step(TRACK), STOP, step(ESTOP), *RELEASE, step(TRACK), touch("pipe_3"), step(TRACK)),
        ),
        # An acknowledged landing ends within a brake.
        (
            "collision",
            (IMPOSSIBLE, step(LAND), *RELEASE, step(HOLD, ms=204), touch("pipe_3"), step(HOLD)),
        ),
        (
            "collision",
            (step(TRACK), put(touch_age=9.0), step(ESTOP)),
        ),  # no hit is felt without a touch
    ],
)
def test_a_breach_is_found(kind, story):
    assert play(*story) == {kind}


@pytest.mark.parametrize(
    ("kinds", "story"),
    [
        # It may be at any height, and touches the floor; the walls count.
        (set(), (touch("floor"), step(TRACK, position=(1.0, 1.0, -5.0)))),
        ({"fence"}, (touch("floor"), IMPOSSIBLE, step(LAND, position=OUTSIDE))),
        ({"stop"}, holds(HOLD, (8.9, 1.0, 0.1), (0.59, 0.0, 0.0))),
        ({"cap"}, holds(HOLD, (1.0, 1.0, 0.1), (0.0, 0.0, 1e-9))),
    ],
)
def test_the_limits_of_the_rover_are_its_own(kinds, story):
    assert play(*story, robot="rover") == kinds
