# SPDX-License-Identifier: Apache-2.0

"""Flights in C and in Python have the same bits, whatever the cloud sends."""

import logging
from dataclasses import replace
from functools import cache, partial
from itertools import product
from math import atan2, inf
from unittest.mock import Mock

import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.config.resolved import ResolvedGuard
from cloudrc.flight.assembly.world import build_world
from cloudrc.physics.sim.engine import mujoco
from cloudrc.physics.sim.memory import without_contacts
from cloudrc.physics.sim.onboard import Accelerator, Direct
from cloudrc.physics.sim.simulator import Simulator
from cloudrc.robots.native import robot as native
from cloudrc.robots.native.library import SWITCH, library
from cloudrc.robots.native.robot import NativeRobot
from cloudrc.robots.onboard import diff_drive, multirotor
from cloudrc.robots.onboard._twins import DiffDriveTwin, MultirotorTwin
from cloudrc.robots.pelican import twin
from cloudrc.robots.pelican.low_level import LowLevel
from cloudrc.robots.pelican.onboard import accelerator
from cloudrc.robots.pelican.twin import PelicanTwin
from cloudrc.wire.messages import Command, GuardState
from cloudrc.wire.tunnel.end import Identity
from cloudrc.world.guard.state import Guard
from cloudrc.world.robot import STEP, Robot
from tests.conftest import nightly, nightly_rows
from tests.fences import FENCE
from tests.flights.conftest import CLOCK, ring, sha256
from tests.world.conftest import model_of, simulate
from tests.world.guard.conftest import LIMITS, MS, SECOND, UP, Flight, hostile

pytestmark = [
    pytest.mark.skipif(library().run is None, reason=library().text),
    pytest.mark.usefixtures("shared_files"),
]


def parts(scene="empty", limits=LIMITS):
    return simulate("pelican", scene), LowLevel(), Guard(limits, FENCE)


def native_robot(*given):
    return NativeRobot(*given, PelicanTwin)


def both(scene="empty", limits=LIMITS):
    return [make(*parts(scene, limits)) for make in (Robot, native_robot)]


class Count:
    """Counts the steps that run in C."""

    def __init__(self, robot):
        self.steps, self._run = 0, robot._run_steps
        robot._run_steps = self

    def __call__(self, *given):
        ran = self._run(*given)
        self.steps += ran
        return ran


class Pilot(Flight):
    """Flies a robot with the commands of a policy, and notes everything that is to be equal."""

    parts = (4, 6)

    def __init__(self, robot):
        super().__init__(robot.simulator, robot)
        self.seen = []

    def look(self):
        simulator, guard = self.robot.simulator, self.guard
        self.seen += [simulator.readings, simulator.actuators.speeds, simulator.steps]
        self.seen += [guard.state, guard.reference, dict(guard.counts)]
        self.seen += [(simulator.take_contact_force(), simulator.read_sensors())]
        self.seen += [simulator.take_contacts()]


def scaled(seed, scale):
    """Lift off for 1 s, then jump between velocities."""
    policy = hostile(seed)
    return lambda pilot: UP if pilot.now_ns < SECOND else tuple(scale * v for v in policy(pilot))


def silence(pilot):
    """Command in jumps, with a pause that leads to HOLD, and at the end no commands at all."""
    second = pilot.now_ns * 1e-9
    if 2.0 < second < 3.5 or second > 5.5:
        return None
    return (1.0, -1.5, 1.0 if second < 1.0 else 0.0)


TOUCHING, IN_PIPE = (8.0, -6.42, 0.9), (-1.0, 0.5, 0.5)
HOLDS = ResolvedGuard(hold_max_s=2.0)


@pytest.mark.parametrize(
    ("make", "seconds", "spawn", "limits", "least"),
    [
        # Large velocities reach caps, fence and floor; small ones stay where C flies.
        *((partial(scaled, seed, 1.0), 7.0, None, LIMITS, 10) for seed in range(2)),
        (partial(scaled, 0, 0.1), 7.0, None, LIMITS, 1000),
        (partial(scaled, 0, 0.1), 4.0, IN_PIPE, LIMITS, 500),
        *nightly_rows(
            *((partial(scaled, seed, 1.0), 7.0, None, LIMITS, 10) for seed in (2, 3)),
            *((partial(scaled, seed, 0.1), 7.0, None, LIMITS, 1000) for seed in (1, 2, 3)),
            *((partial(scaled, seed, 0.1), 4.0, IN_PIPE, LIMITS, 500) for seed in (1, 2)),
        ),
        (lambda: lambda pilot: (0.3, 0.0, 0.1), 1.5, TOUCHING, LIMITS, 500),
        (lambda: silence, 14.0, None, HOLDS, 900),
    ],
)
def test_commands_fly_the_same_in_c(make, seconds, spawn, limits, least, scene_at):
    python, c = both(scene_at(*spawn) if spawn else "empty", limits)
    count = Count(c)
    pilots = [Pilot(robot).fly(seconds, make()) for robot in (python, c)]
    assert pilots[0].seen == pilots[1].seen
    assert count.steps >= least
    if limits is HOLDS:
        assert {GuardState.TRACK, GuardState.HOLD, GuardState.LAND} <= {*pilots[1].seen[3::8]}
    if spawn is TOUCHING:
        assert any(touches and touches[0].body == "board" for touches in pilots[1].seen[7::8])


@pytest.mark.parametrize("seed", [1, *nightly(0, 2)])
def test_plans_fly_the_same_in_c(seed):
    """Commands every 10 ms or much later; a plan's velocities are due at odd times."""
    robots = both(limits=ResolvedGuard(speed_max_mps=4.0, plan_max_s=0.8))
    count, pilots = Count(robots[1]), [Pilot(robot) for robot in robots]
    for pilot in pilots:
        rng = np.random.default_rng(seed)

        def policy(pilot, rng=rng):
            now_ns = pilot.now_ns
            velocity = UP if now_ns < SECOND else tuple(rng.uniform(-0.8, 0.8, 3).tolist())
            plan = tuple(map(tuple, rng.uniform(-0.8, 0.8, (int(rng.integers(0, 40)), 3)).tolist()))
            planned_ns = now_ns + int(rng.integers(0, 60 * MS))
            sends = now_ns < 3 * SECOND or rng.random() < 0.05
            return Command(0, now_ns, 0, velocity, 0.0, plan, planned_ns) if sends else None

        pilot.fly(6.0, policy)
    assert pilots[0].seen == pilots[1].seen
    assert count.steps > 1000


def multirotor_parts(tilt=0.0, **drag):
    """Return the parts of an x2; `tilt` lets one rotor push to the side, too."""
    model = model_of("x2")
    model.actuator_gear[0, 0] = tilt
    simulator = Simulator(model, multirotor.actuators(model, STEP, **drag))
    return simulator, multirotor.build(model, **drag), Guard(LIMITS, FENCE)


DRAGGED = partial(multirotor_parts, drag_s_per_m=0.03)
TILTED = partial(multirotor_parts, tilt=0.1, drag_s_per_m=0.03)


def rover_parts():
    model, fence = model_of("rover"), replace(FENCE, ground=0.1)
    return Simulator(model, Direct(model.nu)), diff_drive.build(model), Guard(LIMITS, fence)


@pytest.mark.parametrize(
    ("make", "twin", "climbs", "least", "scale"),
    [
        (multirotor_parts, MultirotorTwin, 1.0, 1000, 0.2),
        (DRAGGED, MultirotorTwin, 1.0, 1000, 0.2),
        *((TILTED, MultirotorTwin, 1.0, 1000, scale) for scale in (0.2, 1.5)),
        *((rover_parts, DiffDriveTwin, 0.0, 2500, scale) for scale in (0.2, 1.5)),
        *nightly_rows(
            *((make, MultirotorTwin, 1.0, 1000, 1.5) for make in (multirotor_parts, DRAGGED))
        ),
    ],
)
def test_other_robots_fly_and_drive_the_same_in_c(make, twin, climbs, least, scale):
    """Velocities jump, the yaw goes round, and commands stop for 1 s."""
    robots = Robot(*make()), NativeRobot(*make(), twin)
    count, pilots = Count(robots[1]), [Pilot(robot) for robot in robots]
    for pilot in pilots:
        rng = np.random.default_rng(1)

        def policy(pilot, rng=rng):
            now_ns = pilot.now_ns
            if 5 * SECOND < now_ns < 6 * SECOND:
                return None
            if now_ns % (500 * MS) == 0:
                pilot.wanted = rng.uniform(-scale, scale, 3), rng.uniform(-2.0, 3.0)
            velocity, yaw_rate = pilot.wanted
            up = 1.0 if now_ns < SECOND else velocity[2]
            return Command(0, now_ns, 0, (*velocity[:2].tolist(), climbs * up), yaw_rate)

        pilot.fly(8.0, policy)
    assert pilots[0].seen == pilots[1].seen
    assert count.steps > least


def test_c_finds_the_contacts_with_a_body_that_mujoco_does_not_fuse(scene_with):
    """`exclude` names the pillar, so that the pillar stays a body of its own."""
    pillar = '<body name="pillar" pos="1.2 0 1"><geom type="capsule" size=".1 1"/></body>'
    scene = scene_with(pillar, '<contact><exclude body1="pillar" body2="floor"/></contact>')

    def into_the_pillar(pilot):
        return UP if pilot.now_ns < SECOND else (0.8, 0.0, 0.0)

    pilots = [Pilot(robot).fly(2.5, into_the_pillar) for robot in both(scene)]
    assert pilots[0].seen == pilots[1].seen
    touches = [touch for each in pilots[1].seen[7::8] for touch in each]
    assert touches[0].body == "pillar"


def test_c_runs_the_steps_on_the_ground_and_of_the_take_off():
    robots = both()
    count, seen = Count(robots[1]), ([], [])
    for robot, found in zip(robots, seen, strict=True):
        for now_ns in range(0, SECOND, 10 * MS):
            if now_ns == 200 * MS:
                robot.guard.start_mission(now_ns)
            robot.guard.accept_command(Command(0, now_ns, 0, (0.3, 0.0, 1.0), 0.0), now_ns)
            robot.run(now_ns, now_ns + 10 * MS)
            found += [robot.simulator.readings, robot.guard.reference, robot.simulator.touch_age]
    assert seen[0] == seen[1]
    assert count.steps == 500
    assert robots[1].guard.take_off.over


def test_what_c_calls_for_an_angle_has_the_bits_of_python():
    values = (0.0, -0.0, 1.0, -0.3, inf, -inf, 5e-324, 1e300)
    for y, x in product(values, repeat=2):
        assert native._atan2()(y, x).hex() == atan2(y, x).hex()


def test_python_looks_at_no_contact_that_goes_on(monkeypatch):
    robot = NativeRobot(*rover_parts(), DiffDriveTwin)
    looks = Mock(wraps=robot.simulator._note_contacts)
    monkeypatch.setattr(robot.simulator, "_note_contacts", looks)
    Pilot(robot).fly(2.0, lambda pilot: (0.5, 0.0, 0.0))
    assert 0 < looks.call_count < 10


def nearest(robot, position):
    """Return how far the ball around a robot at `position` is from every obstacle of `step.c`."""
    rows, *_ = robot._flight.keep
    along = np.einsum("nij,ni->nj", rows[:, 3:12].reshape(-1, 3, 3), position - rows[:, :3])
    beyond = np.maximum(abs(along) - rows[:, 12:15], 0.0)
    return (np.sqrt((beyond**2).sum(1)) - rows[:, 15]).min() - robot._flight.robot_radius


@pytest.mark.parametrize("kind", ["margin", "gap"])
def test_where_c_looks_for_no_contact_there_is_none(kind):
    simulator, *others = parts("pipes")
    model, data = simulator.model, simulator.data
    rng, free = np.random.default_rng(1), 0
    getattr(model, f"geom_{kind}")[:] = rng.choice([0.0, 0.1], model.ngeom)
    robot = native_robot(simulator, *others)
    for _ in range(3000):
        data.qpos[:3] = rng.uniform((-2.0, -7.0, 0.3), (9.0, 3.0, 1.6))
        data.qpos[3:] = rng.normal(size=4)
        mujoco.mj_forward(model, data)
        is_free = nearest(robot, data.qpos[:3]) > 0.0
        free += is_free
        assert not (is_free and data.ncon)
    assert 300 < free < 2900


@pytest.mark.parametrize("of_user", [False, True])
def test_without_contacts_geoms_have_poses_only_for_a_sensor(of_user):
    model = model_of("pelican")
    data = mujoco.MjData(model)
    touch = int(model.sensor_adr[0])
    free = without_contacts(model, {touch, touch + 1} if of_user else {touch})
    mujoco.mj_forward(model, data)
    before = data.geom_xpos.copy()
    for _ in range(5):
        mujoco.mj_step(free, data)
    assert data.qpos[2] < before[:, 2].max()
    assert np.array_equal(data.geom_xpos, before) is not of_user


def test_in_air_that_acts_on_geoms_c_uses_the_whole_model():
    simulator, *others = parts()
    simulator.model.opt.density = 1.2
    assert native_robot(simulator, *others)._flight.robot_radius == inf


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("steps", ("world.onboard.integral_limit_xy=0.3", "guard.speed_max_mps=0.5",
                   "mission.steps.count=2")),
        *nightly_rows(("paper", ()), ("paper-verbatim", ()), ("fast", ())),
        ("steps", ("world.robot=x2", "mission.steps.count=2")),
        ("pillars", ("mission.waypoints=[{position_m: [1.5, 1.2]}]",)),
        *nightly_rows(("steps", ("world.robot=nano",)), ("fast", ("world.robot=x2",))),
        ("hover", ("link.uplink.blackouts=[{start_s: 3, duration_s: 2}]",
                   "mission.waypoints.0.dwell_s=3")),
    ],
)  # fmt: skip
def test_an_experiment_has_the_same_records_in_c(name, settings, monkeypatch):
    experiment, identity = load_experiment(name, settings), Identity(CLOCK, bytes(16), ring())
    assert isinstance(build_world(experiment, identity).robot, NativeRobot)
    in_c = sha256(experiment)
    monkeypatch.setenv(SWITCH, "0")
    assert sha256(experiment) == in_c
    assert not isinstance(build_world(experiment, identity).robot, NativeRobot)


@pytest.mark.parametrize("setting", ["wind.velocity_mps=[0, 1]", "plant.mass_factor=1.1"])
def test_what_c_cannot_simulate_is_flown_in_python(setting):
    experiment = load_experiment("hover", [f"world.{setting}"])
    identity = Identity(CLOCK, bytes(16), ring())
    assert not isinstance(build_world(experiment, identity).robot, NativeRobot)


def test_observers_and_a_tape_see_every_step():
    robot = native_robot(*parts())
    count, seen = Count(robot), []
    robot.observers.append(Mock(see_step=lambda *step: seen.append(step)))
    Pilot(robot).fly(1.0, lambda pilot: (0.0, 0.0, 1.0))
    assert len(seen) == 500
    robot.observers.clear()
    robot.simulator.tape = []
    Pilot(robot).fly(1.0, lambda pilot: (0.0, 0.0, 1.0))
    assert len(robot.simulator.tape) == 500
    assert count.steps == 0


def unfit():
    raise ValueError("unknown")


@pytest.mark.parametrize(
    ("module", "what", "value", "text"),
    [
        (twin, "_VALUES", twin._VALUES | {"mass": 1.05 + 1e-12}, "C and Python differ"),
        (native, "contacts_offset", unfit, "MuJoCo is not as expected: ValueError('unknown')"),
    ],
)
def test_a_failed_self_test_means_python_and_one_warning(
    module, what, value, text, monkeypatch, caplog
):
    monkeypatch.setattr(native, "_self_test", cache(native._self_test.__wrapped__))
    monkeypatch.setattr(module, what, value)
    with caplog.at_level(logging.WARNING):
        assert accelerator() == Accelerator(None, f"Python ({text})")
    (warning,) = [record.message for record in caplog.records]
    assert warning == f"all steps run in Python: {text}; report this"
