"""Helpers for tests of the guard: a guard alone, a flying robot with hostile clouds, and proofs.

A proof runs plain Python for all 64-bit floats at once, with z3. A `Symbol` stands for any float.
At each comparison the run forks; a run takes one branch, and the conditions that hold on it are its
path. Comparisons, sums, products, negation and division by a power of two are those of IEEE 754,
bit by bit. Other divisions and square roots would take z3 minutes. They are replaced by bounds that
correct rounding guarantees.
"""

import sys
from math import frexp, hypot, sqrt
from random import Random

import pytest
import z3

from cloudrc.config.resolved import ResolvedGuard
from cloudrc.config.robot import RobotLimits
from cloudrc.messages import UPRIGHT, ZERO, Command, GuardState
from cloudrc.robots.pelican.low_level import LowLevel
from cloudrc.sim.readings import Readings
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import Robot
from tests.fences import FENCE
from tests.world.conftest import simulate

MS = 1_000_000
TICK = 2 * MS
DT = 0.002
SECOND = 1000 * MS
HERE = (1.0, 2.0, 1.3)
LIMITS = ResolvedGuard()


def command(velocity=(1.0, 0.0, 0.0), basis_ns=0, yaw_rate=0.0):
    return Command(0, basis_ns, 0, velocity, yaw_rate)


def sensed(position=HERE, velocity=ZERO):
    return Readings.of((*position, *UPRIGHT), (*velocity, *ZERO))


def armed(limits=LIMITS, now_ns=0, fence=FENCE, **robot):
    """Return a guard in GROUND with a started mission."""
    guard = Guard(limits, fence, RobotLimits(**robot))
    guard.start_mission(now_ns)
    return guard


def tracking(velocity=(1.0, 0.0, 0.0), limits=LIMITS):
    """Return a guard in TRACK since 0 ns, by a command with a basis of 0 ns."""
    guard = armed(limits)
    assert guard.accept_command(command(velocity), 0) is None
    return guard


def run(guard, start_ns, end_ns, position=HERE, velocity=ZERO):
    """Tick with constant readings; return the references."""
    return [
        guard.step(now_ns, sensed(position, velocity), DT)
        for now_ns in range(start_ns, end_ns, TICK)
    ]


def feed(guard, start_ns, count, velocity=(1.0, 0.0, 0.0), position=HERE, moves=ZERO):
    """Give fresh commands and tick, with constant readings; return the time after the last one."""
    now_ns = start_ns
    for _ in range(count):
        guard.accept_command(command(velocity, basis_ns=now_ns), now_ns)
        run(guard, now_ns, now_ns + 10 * MS, position, moves)
        now_ns += 10 * MS
    return now_ns


def holding(limits=LIMITS):
    """Return a guard in HOLD in a mission, at rest, at 2 s."""
    guard = tracking(limits=limits)
    run(guard, 0, 2000 * MS)
    assert guard.state is GuardState.HOLD
    return guard


def landing(limits=LIMITS):
    """Return a guard in LAND after impossible commands, at 2 s."""
    return bring_down(holding(limits), 2 * SECOND)


def bring_down(guard, now_ns):
    """Return the guard in LAND after five impossible commands."""
    for _ in range(5):
        guard.accept_command(command((float("nan"), 0.0, 0.0), now_ns), now_ns)
    assert guard.state is GuardState.LAND
    return guard


def stopped(guard):
    guard.stop(0)
    assert guard.state is GuardState.ESTOP
    return guard


def states(guard):
    return [change.state for change in guard.take_changes()]


@pytest.fixture(scope="module")
def simulator():
    return simulate("pelican", "empty")


UP = (0.0, 0.0, 1.0)


class Flight:
    """A robot in free air, commanded at 100 Hz."""

    parts = (10,)
    """Parts of a period [ms] in which the robot runs, as arrivals of commands divide it."""

    def __init__(self, simulator, robot=None):
        self.robot = robot or Robot(simulator, LowLevel(), Guard(LIMITS, FENCE))
        self.guard, self.now_ns = self.robot.guard, 0
        self.robot.put_on_ground(0, "test")
        self.guard.start_mission(0)
        self.room = 9.0  # smallest distance to a wall or the ceiling [m]

    @property
    def readings(self):
        return self.robot.simulator.readings

    @property
    def speed(self):
        return hypot(*self.readings.velocity)

    def fly(self, seconds, policy=None):
        """Fly on; the policy gives velocities or commands, None means silence."""
        for _ in range(round(seconds * 100)):
            sent = policy(self) if callable(policy) else policy
            if sent is not None:
                if type(sent) is not Command:
                    sent = Command(0, self.now_ns, 0, sent, 0.0)
                self.guard.accept_command(sent, self.now_ns)
            for part in self.parts:
                self.robot.run(self.now_ns, self.now_ns + part * MS)
                self.now_ns += part * MS
            self.look()
        return self

    def look(self):
        """Measure after each period."""
        x, y, z = self.readings.position
        (ax, ay, _), (bx, by, bz) = FENCE.low, FENCE.high
        self.room = min(self.room, x - ax, bx - x, y - ay, by - y, bz - z)


def hostile(seed):
    """Make a policy that jumps between extreme velocities at random times."""
    rng, until_ns, velocity = Random(seed), 0, UP

    def policy(flight):
        nonlocal until_ns, velocity
        if flight.now_ns >= until_ns:
            until_ns = flight.now_ns + rng.choice((20, 50, 200, 500, 1000, 3000)) * MS
            velocity = tuple(rng.choice((-9.0, -3.0, 0.0, 3.0, 9.0)) for _ in range(3))
        return velocity

    return policy


DOUBLE, ROUND = z3.Float64(), z3.RNE()
LARGEST = sys.float_info.max


def arithmetic(operation):
    return lambda self, other: Symbol(self.run, operation(ROUND, self.term, self.of(other)))


def comparison(operation):
    return lambda self, other: self.run.take(operation(self.term, self.of(other)))


class Symbol:
    """Any float that satisfies the path of its run."""

    def __init__(self, run, term):
        self.run, self.term = run, term

    def of(self, other):
        return other.term if isinstance(other, Symbol) else z3.FPVal(other, DOUBLE)

    def __neg__(self):
        return Symbol(self.run, z3.fpNeg(self.term))

    def __abs__(self):
        return Symbol(self.run, z3.fpAbs(self.term))

    __add__ = __radd__ = arithmetic(z3.fpAdd)
    __sub__ = arithmetic(z3.fpSub)
    __mul__ = __rmul__ = arithmetic(z3.fpMul)
    __lt__, __le__ = comparison(z3.fpLT), comparison(z3.fpLEQ)
    __gt__, __ge__ = comparison(z3.fpGT), comparison(z3.fpGEQ)

    def __truediv__(self, other):
        """Divide n >= 0 by d >= 0.1, both finite: the quotient is any finite float >= 0.

        Division by a power of two is exact, for any n.
        """
        if isinstance(other, float) and frexp(other)[0] == 0.5:
            return self * (1.0 / other)
        n, d, q = self.term, self.of(other), self.run.fresh("quotient").term
        self.run.prove(z3.And(n >= 0.0, n <= 1e299, d >= 0.1, z3.Not(z3.fpIsInf(d))))
        self.run.learn(z3.And(q >= 0.0, q <= 1e300))
        return Symbol(self.run, q)


class Run:
    """One path through the code."""

    def __init__(self, decisions):
        self.decisions, self.taken, self.path, self.names = decisions, 0, [], 0

    def fresh(self, name):
        """Return a symbol for any float at all."""
        self.names += 1
        return Symbol(self, z3.FP(f"{name}_{self.names}", DOUBLE))

    def learn(self, fact):
        self.path.append(fact)

    def take(self, condition):
        """Choose the branch of this run; another run takes the other branch."""
        if self.taken == len(self.decisions):
            self.decisions.append(True)
        decision = self.decisions[self.taken]
        self.taken += 1
        self.learn(condition if decision else z3.Not(condition))
        return decision

    def prove(self, claim):
        """Fail if there is a counterexample on this path."""
        solver = z3.Solver()
        solver.add(*self.path, z3.Not(claim))
        answer = solver.check()
        assert answer == z3.unsat, f"{answer}: {solver.model() if answer == z3.sat else claim}"

    def is_possible(self):
        """Tell whether any float takes this path."""
        solver = z3.Solver()
        solver.add(*self.path)
        return solver.check() != z3.unsat


def root(x, top=LARGEST):
    """Return the square root of a finite x >= 0: a finite float >= 0.

    For x up to `top` it is at most the root of `top`: a correctly rounded root is monotonic.
    """
    x.run.prove(z3.And(x.term >= 0.0, z3.Not(z3.fpIsInf(x.term))))
    r = x.run.fresh("root")
    x.run.learn(z3.And(r.term >= 0.0, r.term <= 1.5e154))
    x.run.learn(z3.Implies(x.term <= top, r.term <= sqrt(top)))
    return r


def everywhere(check):
    """Run `check` on every path; return the number of possible paths."""
    decisions, paths = [], 0
    while True:
        run = Run(decisions)
        check(run)
        paths += run.is_possible()
        del decisions[run.taken :]
        while decisions and not decisions[-1]:
            decisions.pop()
        if not decisions:
            return paths
        decisions[-1] = False
