# SPDX-License-Identifier: Apache-2.0

"""Prove what plain Python computes, for all floats.

A proof runs plain Python for all 64-bit floats at once, with z3. A `Symbol` stands for any float.
At each comparison the run forks; a run takes one branch, and the conditions that hold on it are its
path. Comparisons, sums, products, negation and division by a power of two are those of IEEE 754,
bit by bit. Other divisions and square roots would take z3 minutes. They are replaced by bounds that
correct rounding guarantees.
"""

import sys
from math import frexp, sqrt

import pytest

z3 = pytest.importorskip("z3", reason="z3 comes with the extra deep; run: make .venv/deep")
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
