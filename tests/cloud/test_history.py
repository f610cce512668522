"""Which velocity the robot follows, by the commands with plans and their echoes."""

import pytest

from cloudrc.cloud.predictors import command_history
from cloudrc.cloud.predictors._history import History
from cloudrc.messages import UPRIGHT, ZERO, Command, Odometry

MS = 1_000_000


def planned(stamp_ms, planned_ms, *speeds):
    """Return a command along x, with a plan [m/s]."""
    first, *rest = [(speed, 0.0, 0.0) for speed in speeds]
    return Command(stamp_ms * MS, 0, 0, first, 0.0, tuple(rest), planned_ms * MS)


def along_x(segments):
    return [(velocity[0], pytest.approx(duration)) for velocity, duration in segments]


def test_the_past_has_the_steps_of_the_applied_plans():
    history = History()
    history.add(planned(0, 100, 1.0, 2.0, 3.0))
    history.add(planned(10, 110, 5.0, 6.0, 7.0))
    history.note_applied(0, 112 * MS)
    history.note_applied(10 * MS, 124 * MS)
    assert along_x(history.past(114 * MS, 134 * MS)) == [
        *((2.0, 0.006), (3.0, 0.004), (6.0, 0.006), (7.0, 0.004)),
    ]


def test_a_plan_begins_at_its_own_time_however_late_it_is():
    history = History()
    for k in range(3):
        history.add(planned(10 * k, 100 + 10 * k, 1.0 + k, 2.0 + k))
    history.note_applied(0, 130 * MS)
    basis = Odometry(100 * MS, ZERO, UPRIGHT, ZERO, ZERO)
    assert history.shift_ns(basis, 0.02) == 100 * MS
    ahead = history.ahead(100 * MS, 120 * MS, 100 * MS)
    assert along_x(ahead) == [(1.0, 0.01), (2.0, 0.01)]


def test_command_history_knows_the_plan_between_two_commands():
    """At 20 Hz the robot flies four steps of the plan before the next command."""
    planning, plain = command_history.build(), command_history.build()
    for k in range(20):
        planning.commanded(
            planned(50 * k, 50 * k, *([0.0, 1.0, 1.0, 1.0, 1.0] if k > 9 else [0.0]))
        )
        plain.commanded(planned(50 * k, 50 * k, 0.0))
    basis = Odometry(850 * MS, ZERO, UPRIGHT, ZERO, ZERO)
    assert plain.predict(basis, 0.1).position[0] == 0.0
    assert planning.predict(basis, 0.1).velocity[0] > 0.1
