# SPDX-License-Identifier: Apache-2.0

"""A linear plant, and the closed forms that it reproduces."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from examples import canon
from tests.conftest import nightly_rows

ROWS = {row.name: row for row in canon.rows()}
LIKE_ANOTHER = [
    "E[x²] through `Networked`, loss .1",
    "at 2",
    "at 3",
    "the same with loss in bursts",
    "LQG, loss .3, UDP-like",
    "LQG through `Networked`, UDP-like",
    "2 inputs in a packet",
    "all inputs in a packet",
    "Schenato 2009: 1 input, held",
]
"""Rows that differ from one that is measured daily in a parameter or in a rule."""


LONGER = {
    "P(age > D + 2T)",
    "Costa 2016: peak age [s]",
    "Kaul 2012: age, loss .1 [s]",
    "starvation of `async`, share 0.5, 30 steps late",
}
"""Rows whose error is too large in a twentieth of the steps, and those that share its run."""
DAILY = sorted(ROWS.keys() - {canon.HEAVY, *LIKE_ANOTHER})


@pytest.mark.parametrize(
    ("name", "scale"),
    [(name, 0.1 if name in LONGER else 0.05) for name in DAILY]
    + nightly_rows(*[(name, 0.1) for name in LIKE_ANOTHER], *[(name, 1.0) for name in ROWS]),
)
def test_a_closed_form_is_measured(name, scale):
    exact, mean, error = ROWS[name].at(scale)
    assert error < 0.04 * exact
    assert abs(mean - exact) < 3.0 * error


@pytest.mark.parametrize(("p", "is_finite"), [(0.1, True), (0.4, True), (0.41, False)])
def test_the_variance_of_p_is_finite_below_one_over_the_fourth_power(p, is_finite):
    """a = 1.25: 1 / a^4 = .4096. After k losses in a row, P is 1 + a^2 + ... + a^(2 k)."""
    k = np.arange(700)
    values, chances = np.cumsum(1.25 ** (2.0 * k)), (1.0 - p) * p**k
    mean, variance = canon.moments_of_p(1.25, p)
    assert mean == pytest.approx((chances * values).sum())
    squares = np.cumsum(chances * values**2)
    assert bool(squares[-1] < 1.01 * squares[350]) is is_finite
    assert variance == pytest.approx(squares[-1] - mean**2) if is_finite else np.isinf(variance)


def test_send_on_delta_needs_a_third_of_the_variance_where_steps_are_short():
    """The mean square of a state that is reset every n steps is (n + 1) / 2."""
    square, share = canon.send_on_delta_exact(30.0)
    assert (1.0 / share + 1.0) / 2.0 / square == pytest.approx(3.0, abs=0.05)
    few = [canon.send_on_delta_exact(delta)[0] for delta in (1.0, 2.0, 3.0)]
    assert few == pytest.approx([1.191, 1.860, 2.878], abs=0.001)


def test_async_starves_from_the_whole_number_of_actions_at_which_it_asks():
    """A share of .45 asks when 22 of 50 actions are left, not 22.5."""
    exact, found = canon.starvation(0.45, 30, 1, 5_000)
    assert exact == 8 / 36
    assert found.mean() == pytest.approx(exact, abs=0.004)


def test_a_step_follows_the_matrices():
    a, b, c = np.array([[1.0, 0.5], [0.0, 0.9]]), np.array([[0.0], [2.0]]), np.array([[1.0, 1.0]])
    env = gymnasium.make("cloudrc/Linear-v0", A=a, B=b, C=c, Q=2.0, R=[[3.0]], W=0.0, x0=[1.0, 4.0])
    first, info = env.reset(seed=1)
    assert first == 5.0
    seen, reward, terminated, truncated, after = env.step(np.array([0.5]))
    assert after["x"] == pytest.approx(a @ info["x"] + b @ [0.5])
    assert seen == pytest.approx(c @ after["x"])
    assert reward == -(2.0 * (1.0 + 16.0) + 3.0 * 0.25)
    assert (terminated, truncated) == (False, False)


def test_noise_has_its_covariance_and_a_large_state_ends_the_episode():
    covariance = np.array([[2.0, 1.0], [1.0, 1.0]])
    env = gymnasium.make("cloudrc/Linear-v0", A=np.zeros((2, 2)), W=covariance, V=0.25, limit=4.0)
    env.reset(seed=1)
    steps = [env.step(np.zeros(2)) for _ in range(4000)]
    states = np.array([info["x"] for *_, info in steps])
    outputs = np.array([seen for seen, *_ in steps])
    assert np.cov(states.T) == pytest.approx(covariance, abs=0.1)
    assert np.cov((outputs - states).T) == pytest.approx(0.25 * np.eye(2), abs=0.02)
    assert [over for _, _, over, *_ in steps] == (abs(states).max(axis=1) > 4.0).tolist()


@pytest.mark.filterwarnings("ignore:.*Box:UserWarning")  # it advises finite, symmetric bounds
def test_gymnasium_accepts_it():
    check_env(gymnasium.make("cloudrc/Linear-v0", A=np.eye(2)).unwrapped)
