# SPDX-License-Identifier: Apache-2.0

"""The judgement of stability, against a linear model of the loop and against known responses."""

import numpy as np
import pytest

from cloudrc.config.load import load_experiment
from cloudrc.studies.stability import fly_step, judge
from tests.conftest import nightly, nightly_rows

pytestmark = pytest.mark.usefixtures("shared_files")

PUBLISHED = (0.8, 0.8, 1.5), (0.0, 0.0, 0.0)
FAST = (2.5, 2.5, 3.0), (0.5, 0.5, 0.0)
"""Gains P [1/s] and D [1] of the cloud controller in x, y and z."""
MASS, DRAG = 1.06, 0.1645
"""Mass of the robot [kg], and drag of its rotors in a hover [N s/m]: the drag coefficient times the
sum of the four rotor speeds. Source: docs/reference/plant.md, "Robot", "Rotor drag"."""
LAG = 0.0167
"""Time constant of the rotors [s]: the mean of the rates 1/.0125 s (up) and 1/.025 s (down).
Source: docs/reference/plant.md, "Rotor speed"."""
INERTIA = 0.0116
"""Inertia of the whole robot about x [kg m^2], from the MJCF model: M[3, 3] of MuJoCo."""
SAMPLING = 0.012
"""Delay of the loop beside the link [s]: cloud's odometry is up to a command period old, and a
command is held for a period, each 5 ms on average; the onboard controller acts every 2 ms."""


def velocity_loop(axis, s):
    """Return the transfer function from commanded to true velocity at the frequencies `s` [rad/s].

    Onboard, a PID turns the velocity error into a force, C(s) = Kp + Ki/s + Kd s. The robot answers
    with an acceleration: m v' = A(s) F - c v. In z, A is the lag of the rotors, R = 1/(1 + LAG s).
    In x and y the robot has to tilt first: the torque k_R (wanted - tilt) - k_w rate acts through
    the rotors, so that A = R / (J s^2 + k_w s R + k_R R), with k_R = 1 and k_w = .22. In x the
    weight of the arm saturates the integral, so that y, with the integral, is nearer to the limit.
    The closed loop is G = L / (1 + L), L = C A / (m s + c).

    Source: docs/reference/onboard.md.
    """
    rotors = 1.0 / (1.0 + LAG * s)
    if axis == "z":
        controller, actuator, drag = 10.0 + 2.5 / s + 0.5 * s, rotors, 0.0
    else:
        controller, drag = 4.0 + 1.0 / s + 0.3 * s, DRAG
        actuator = rotors / (INERTIA * s**2 + 0.22 * s * rotors + rotors)
    open_loop = controller * actuator / (MASS * s + drag)
    return open_loop / (1.0 + open_loop)


def phase_margin(gain_p, gain_d, axis, delay, predicts):
    """Return the phase margin of the outer loop [rad] with a round trip of `delay` [s].

    Cloud commands u = P (setpoint - p') - D v. Without a predictor p' is the delayed position;
    constant_velocity adds the delayed velocity times the horizon, which is the delay T around the
    loop: p' = p + T v. With v = s p the open loop is L = (P (1 + T s) + D s) / s G e^(-s T).
    """
    s = 1j * np.geomspace(0.05, 60.0, 20_000)
    around = delay + SAMPLING
    lead = 1.0 + around * s if predicts else 1.0
    loop = (gain_p * lead + gain_d * s) / s * velocity_loop(axis, s) * np.exp(-s * around)
    phase = np.unwrap(np.angle(loop))  # begins at -90 degrees: an integrator
    above = np.abs(loop) > 1.0
    crossings = np.flatnonzero(above[1:] != above[:-1])
    return np.pi + phase[crossings].min()


def delay_margin(gains, predicts):
    """Return the smallest round trip [s] at which an axis has no phase margin left."""
    delays = np.arange(0.01, 3.0, 0.005)
    return min(
        next(delay for delay in delays if phase_margin(gain_p, gain_d, axis, delay, predicts) < 0.0)
        for gain_p, gain_d, axis in ((gains[0][1], gains[1][1], "y"), (gains[0][2], 0.0, "z"))
    )


def flown(*settings, rtt=0.0, gains=PUBLISHED, of="steps"):
    """Return an experiment on a constant link with a round trip [s], and limits that fit."""
    limit = rtt + 0.3
    keys = {
        "link.profile": "ideal",
        "cloud.freeze_after_s": max(0.4, limit),
        "cloud.horizon_max_s": max(1.0, limit),
        "guard.command_age_max_ms": max(250.0, limit * 1e3),
        "cloud.controller.gain_p": [*gains[0]],
        "cloud.controller.gain_d": [*gains[1]],
        **({"link.both.delay_ms": rtt * 500} if rtt else {}),
        **dict(text.split("=") for text in settings),
    }
    return load_experiment(of, [f"{key}={value}" for key, value in keys.items()])


@pytest.mark.parametrize(
    ("predictor", "gains"),
    [
        ("last_sample", FAST),
        *nightly_rows(("constant_velocity", FAST), ("last_sample", PUBLISHED)),
        *nightly_rows(("constant_velocity", PUBLISHED)),
    ],
)
def test_the_limit_of_stability_is_that_of_the_linear_model(predictor, gains):
    margin = delay_margin(gains, predictor == "constant_velocity")
    stable = [
        fly_step(flown(f"cloud.predictor={predictor}", rtt=share * margin, gains=gains))["stable"]
        for share in (0.9, 1.1)
    ]
    assert stable == [True, False], f"the model says {margin:.3f} s"


@pytest.mark.parametrize(
    ("predictor", "rtt", "stable"),
    [
        ("command_history", 1.0, True),
        *nightly_rows(*(("command_history", rtt, True) for rtt in (1.5, 3.0))),
        *nightly_rows(*(("last_sample", rtt, False) for rtt in (1.0, 3.0))),
    ],
)
def test_a_predictor_that_replays_the_commands_is_stable_at_3_s(predictor, rtt, stable):
    found = fly_step(flown(f"cloud.predictor={predictor}", rtt=rtt))
    assert found["stable"] == stable, found


@pytest.mark.parametrize(
    "settings",
    [
        ["cloud.controller.gain_p=[0.4, 0.4, 0.4]"],
        [
            "world.wind.velocity_mps=[3, 1]",
            "world.wind.gust_mps=1",
            "world.sensors.position_noise_m=0.02",
            "world.sensors.velocity_noise_mps=0.1",
        ],
        *nightly(
            ["cloud.controller.gain_p=[0.1, 0.1, 0.1]"],
            ["link.profile=lossy"],
            ["tunnel.order=arrival", "link.profile=paper-p3", "guard.command_age_max_ms=400"],
        ),
    ],
)
def test_a_slow_or_disturbed_loop_is_stable(settings):
    found = fly_step(flown(*settings))
    assert found["stable"], found


def test_a_robot_on_the_ground_is_judged_by_its_step_on_the_ground():
    found = fly_step(load_experiment("pillars"))
    assert found["stable"], found


def test_a_robot_that_does_not_follow_is_not_stable():
    assert fly_step(flown("cloud.controller.gain_p=[0, 0, 0]"))["code"] == "unstable"
    aged = flown(rtt=0.4).model_copy(update={"guard": flown().guard})
    assert fly_step(aged)["code"] in ("held", "not_started")


FAILING = """
from cloudrc.cloud.predictors import Predictor
class build(Predictor):
    def predict(self, odometry, horizon):
        return None
"""


def test_a_plug_in_that_fails_is_not_stable(tmp_path):
    (tmp_path / "mine.py").write_text(FAILING)
    found = fly_step(flown(f"cloud.predictor={tmp_path / 'mine.py'}"))
    assert (found["stable"], found["code"]) == (False, "plugin_failed")


def test_the_step_of_a_mission_with_pipes_is_flown_in_free_air():
    assert fly_step(flown(of="paper"))["stable"]


TIMES = np.arange(0.0, 24.0, 0.01)


@pytest.mark.parametrize(
    ("size", "stable"),
    [
        (0.1 * np.exp(-TIMES), True),
        (0.1 * np.exp(-0.06 * TIMES), True),  # slow, without an oscillation
        (0.1 * np.exp(-0.1 * TIMES) * np.cos(2.0 * TIMES), True),
        (0.1 * np.exp(0.02 * TIMES) * np.cos(2.0 * TIMES), False),
        (0.1 * np.cos(2.0 * TIMES), False),
        # A limit cycle that grew at once, whose difference beats.
        (0.3 * np.cos(2.0 * TIMES) * np.cos(0.1 * TIMES), False),
        (np.full_like(TIMES, 0.1), False),
    ],
)
def test_a_response_that_does_not_die_out_is_unstable(size, stable):
    left = np.zeros((len(TIMES), 3))
    left[:, 1] = size
    found = judge((np.int64(TIMES * 1e9), left), 0, 4.0, 0.1)
    assert found["stable"] is stable
    assert stable or " in y " in found["text"]
