"""The invariants: what is a breach, and what is not. Each row is a story and the breaches in it."""

from functools import partial
from operator import methodcaller

import pytest

from cloudrc.faults.watch import ESTOP, GROUND, HOLD, LAND, TRACK
from cloudrc.messages import ZERO, Request, Start
from tests.faults.conftest import FakeRobot

step, offer, request, touch, put, skip = (
    partial(methodcaller, name) for name in ("step", "offer", "request", "touch", "put", "skip")
)
RAMP = 3.0  # braking of the Pelican [m/s^2]
OUTSIDE, FAR = (9.3, 1.0, 1.0), (9.2 + 1.51, 1.0, 1.0)
NAN = float("nan")
IMPOSSIBLE = offer(5, "range")
"""Impossible commands, after which the robot may land."""
STOP, END = request(Request.ESTOP), request(Request.END)
SPAWN = request(Request.START, start=Start.SPAWN)
RELEASE = (request(Request.ACKNOWLEDGE, Request.START), offer(10))
SESSION = lambda robot: robot.observer.see_session(robot.now_ns)  # noqa: E731
STEPPED = lambda robot: setattr(robot.simulator, "steps", robot.simulator.steps + 1)  # noqa: E731


def play(*story, **options):
    """Return the kinds of breaches of a story."""
    robot = FakeRobot(**options)
    for deed in story:
        deed(robot)
    return set(robot.watch.counts)


def fly(*references):
    return tuple(step(TRACK, reference=reference) for reference in references)


def holds(state, position, reference):
    return (IMPOSSIBLE, step(state, position=position, reference=reference))


def rest(speed, way):
    moved = step(HOLD, position=(1.0, 1.0 + way, 1.0))
    return (put(velocity=(0.0, speed, 0.0)), step(TRACK), step(HOLD), moved)


MOTION = [
    # The base is inside the fence, except after a stop or a hit.
    ({"fence"}, (IMPOSSIBLE, step(LAND, position=OUTSIDE))),
    (set(), (step(TRACK), STOP, step(ESTOP, position=OUTSIDE))),
    ({"fence"}, (step(TRACK), STOP, step(ESTOP, position=FAR))),
    (set(), (touch("pipe_1"), step(TRACK), step(TRACK, ms=4000, position=OUTSIDE))),
    # After a stop it takes off only where it lies still inside.
    *(
        (kinds, (step(TRACK), STOP, put(velocity), step(ESTOP, ms=2000, position=position),
                 *RELEASE, step(TRACK)))
        for velocity, position, kinds in (
            ((0.0, 0.0, -0.11), None, set()),
            ((0.0, 0.0, -0.13), None, {"fence"}),
        )
    ),
    # The reference grows slowly, may drop at once, and can be stopped before the fence.
    (set(), fly((0.02, 0.013, 0.0))),
    ({"cap"}, fly((0.02, 0.014, 0.0))),
    (set(), holds(HOLD, (8.9, 1.0, 1.0), (0.64, 0.0, 0.0))),  # 0.2 v + v^2/6 <= 0.2: 0.647 m/s
    ({"stop"}, holds(HOLD, (8.9, 1.0, 1.0), (0.66, 0.0, 0.0))),
    ({"cap"}, fly((6.001, 0.0, 0.0))),
    (set(), holds(LAND, (1.0, 1.0, 0.5), (0.0, 0.0, -1.07))),
    ({"fence"}, holds(LAND, (1.0, 1.0, -0.01), ZERO)),
    # Commands are fresh; each step has its tick.
    (set(), (offer(basis_ms=0), step(TRACK, ms=252, fresh=False))),
    ({"stale"}, (offer(), step(TRACK, ms=254, fresh=False))),
    ({"stale"}, (offer(basis_ms=-251),)),
    # A plan is fresh until it ends, for 0.8 s at most, and until the next command or session.
    *((kinds, (offer(plan=plan), *others, step(TRACK, ms=ms, fresh=False)))
      for plan, others, ms, kinds in (
          (40, (), 412, set()), (40, (), 414, {"stale"}), (80, (), 804, {"stale"}),
          (40, (SESSION,), 2, {"stale"}),
      )),
    ({"tick"}, (step(TRACK), STEPPED, step(TRACK))),
    # Without commands it stops within its stopping distance.
    (set(), rest(2.0, 1.56)),
    ({"rest"}, rest(2.0, 1.58)),
    # Rotors stand still on the ground and after a stop; they stop where the robot stands.
    *(({"latch"}, (step(each, turns=True),)) for each in (GROUND, ESTOP)),
    ({"rest"}, (step(HOLD), put((0.0, -0.21, 0.0)), step(GROUND))),
    *((set(), (step(HOLD), put((0.0, 0.0, -3.0)), each, step(GROUND, ms=4)))
      for each in (STOP, SPAWN)),
    ({"rest"}, (step(HOLD), step(GROUND), put((0.0, 0.0, -1.1)), step(GROUND))),
    (set(), (step(HOLD), step(GROUND), put((0.0, 0.0, -1.1), 0.9), step(GROUND))),
]  # fmt: skip


def resumes(count, apart_ms):
    """Offer some fresh commands in HOLD."""
    took = -count * apart_ms
    deeds = [each for _ in range(count) for each in (offer(), skip(apart_ms))]
    return (step(HOLD), *deeds, skip(took), step(TRACK, fresh=False))


def ramp(growth):
    speeds = [n * growth * 0.002 for n in range(5)]
    return (step(HOLD, ms=1000), offer(10), *fly(*((0.6 * v, 0.0, 0.8 * v) for v in speeds)))


NINE = (offer(10), step(HOLD, ms=1000), offer(9))
"""A HOLD with nine fresh commands in it, and ten before."""
OPERATOR = [
    # What is latched ends by an acknowledgement only; one of nothing counts for no later landing.
    *((kinds, (IMPOSSIBLE, request(Request.ACKNOWLEDGE), step(latched), *release, step(HOLD)))
      for latched in (LAND, ESTOP) for kinds, release in ((set(), RELEASE), ({"latch"}, ()))),
    # TRACK needs a mission; nobody has to wait for its end.
    (set(), (step(TRACK), END, step(HOLD, ms=60_100))),
    *(({"latch"}, (each, step(TRACK))) for each in (STOP, END)),
    # A HOLD ends after ten fresh commands in half a second, of one session and mission.
    (set(), resumes(10, 55)),
    *(({"stale"}, resumes(*each)) for each in ((10, 56), (9, 10))),
    ({"stale"}, (*NINE, SESSION, offer(), step(TRACK))),
    # Two changes to TRACK are a second apart.
    ({"hold"}, (step(GROUND), step(TRACK, ms=100), step(HOLD, ms=898), offer(10), step(TRACK))),
    # After a HOLD the reference grows slowly at first.
    ({"cap"}, ramp(1.01 * RAMP)),
    # Five impossible commands just now justify a landing.
    *((kinds, (step(TRACK, ms=100), step(HOLD, ms=100), offer(count, "range"),
               step(HOLD, ms=wait), step(LAND)))
      for count, wait, kinds in ((5, 0, set()), (4, 0, {"hold"}), (5, 100, {"hold"}))),
]  # fmt: skip


@pytest.mark.parametrize(("kinds", "story"), [*MOTION, *OPERATOR])
def test_a_story_has_its_breaches_and_no_others(kinds, story):
    assert play(*story) == kinds


@pytest.mark.parametrize("yaw_rate", [1.001, -1.001, NAN])
def test_the_reference_turns_no_faster_than_the_cap(yaw_rate):
    assert play(step(TRACK), yaw_rate=-1.0) == set()
    assert play(step(TRACK), yaw_rate=yaw_rate) == {"cap"}


@pytest.mark.parametrize(
    ("state", "hold_ms", "wait_ms"), [(HOLD, 60_000, 60_000), (GROUND, 2_000, 10_000)]
)
def test_a_mission_waits_for_its_cloud_as_long_as_configured(state, hold_ms, wait_ms):
    assert play(step(state, ms=wait_ms + 6), hold_ms=hold_ms) == {"hold"}
    assert play(step(state, ms=wait_ms), step(LAND), hold_ms=hold_ms) == {"hold"}
    assert play(step(state, ms=wait_ms + 2), step(LAND), hold_ms=hold_ms) == set()


FALLS = (step(TRACK), STOP, touch("pipe_3"), step(ESTOP), touch("pipe_2"), step(ESTOP))
ENDING = (IMPOSSIBLE, step(LAND), *RELEASE)
"""An acknowledged landing ends within a brake."""


@pytest.mark.parametrize(
    ("kinds", "story"),
    [
        (set(), (touch("board", by_probe=True), step(TRACK))),
        ({"collision"}, (touch("board"), step(TRACK))),
        # A robot that comes down may touch what is below, until it flies again.
        (set(), (IMPOSSIBLE, touch("pipe_3"), step(LAND), touch("floor"), step(LAND))),
        ({"collision"}, (*FALLS, *RELEASE, step(TRACK), touch("pipe_3"), step(TRACK))),
        (set(), (*ENDING, step(HOLD, ms=198), touch("pipe_3"), step(HOLD))),
        ({"collision"}, (*ENDING, step(HOLD, ms=204), touch("pipe_3"), step(HOLD))),
        # No hit is felt without a touch.
        ({"collision"}, (step(TRACK), put(touch_age=9.0), step(ESTOP))),
    ],
)
def test_an_honest_cloud_touches_the_board_by_the_tip_only(kinds, story):
    assert play(*story, honest=True) == kinds
    assert play(*story) == set(), "with a hostile one a contact is no breach"


@pytest.mark.parametrize(
    ("kinds", "story"),
    [
        # It may be at any height, and touches the floor; the walls count.
        (set(), (touch("floor"), step(TRACK, position=(1.0, 1.0, -5.0)))),
        ({"fence"}, (touch("floor"), IMPOSSIBLE, step(LAND, position=OUTSIDE))),
        ({"stop"}, holds(HOLD, (8.9, 1.0, 0.1), (0.59, 0.0, 0.0))),
        ({"cap"}, fly((0.0041, 0.0, 0.0))),
        ({"cap"}, holds(HOLD, (1.0, 1.0, 0.1), (0.0, 0.0, 1e-9))),
    ],
)
def test_the_limits_of_the_rover_are_its_own(kinds, story):
    assert play(*story, robot="rover", honest=True) == kinds
