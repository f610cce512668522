# SPDX-License-Identifier: Apache-2.0

"""A linear plant with noise: networked control of it has closed forms (docs/closed-forms.md).

    x+ = A x + B u + w,  y = C x + v,  reward = -(x' Q x + u' R u)

w and v are white Gaussian noise with covariances W and V. No unit has a meaning here.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded

from cloudrc.base.outside.refusal import naming
from cloudrc.base.outside.values import ANY, InvalidValueError, Quantity
from cloudrc.link.draws import Floats

STEP = Quantity("s", gt=0.0, le=3600.0)
"""Time of a step."""
LIMIT = Quantity(gt=0.0)
"""Size of a state at which an episode ends."""


class Linear(gymnasium.Env[Floats, Floats]):
    """A linear plant with n states, m inputs and k outputs; one step is `dt`.

    The observation is y, shape (k,); the action is u, shape (m,); `info["x"]` has the state, shape
    (n,), for whoever judges. The reward is that of the state before the step and of the action. An
    episode ends as `terminated` where a state is larger than `limit`.
    """

    @naming("cloudrc/Linear-v0")
    def __init__(
        self,
        A: Any = 1.25,
        B: Any = 1.0,
        C: Any = 1.0,
        Q: Any = 1.0,
        R: Any = 0.0,
        W: Any = 1.0,
        V: Any = 0.0,
        x0: Any = 0.0,
        dt: float = 0.01,
        limit: float = 1e9,
    ) -> None:
        """Define the plant. A number in place of a matrix is that times the identity.

        Args:
            A: Matrix of the states, shape (n, n).
            B: Matrix of the inputs, shape (n, m); it decides n if A is a number.
            C: Matrix of the outputs, shape (k, n).
            Q: Price of the states, shape (n, n).
            R: Price of the inputs, shape (m, m).
            W: Covariance of the states' noise, shape (n, n).
            V: Covariance of the outputs' noise, shape (k, k).
            x0: First state, shape (n,); a number is that of each state.
            dt: Time of a step [s].
            limit: Size of a state at which an episode ends [1].

        Raises:
            cloudrc.BadInputError: If a value is no number, or two shapes do not fit.
        """
        states = next((len(ANY.array(each)) for each in (A, B) if np.ndim(each)), 1)
        self._a = _matrix("A", A, (states, states))
        self._b = _matrix("B", B, (states, None))
        self._c = _matrix("C", C, (None, states))
        outputs, inputs = len(self._c), self._b.shape[1]
        self._q = _matrix("Q", Q, (states, states))
        self._r = _matrix("R", R, (inputs, inputs))
        self._w = _root("W", _matrix("W", W, (states, states)))
        self._v = _root("V", _matrix("V", V, (outputs, outputs)))
        self._is_noisy = bool(self._v.any())
        self._first = ANY.array(x0, "x0").astype(float)
        if self._first.shape not in ((), (states,)):
            raise InvalidValueError(f"x0 has the shape {self._first.shape}, not ({states},)")
        self.dt, self._limit = STEP.of(dt, "dt"), LIMIT.of(limit, "limit")
        self._x: Floats | None = None  # before the first episode
        self.observation_space = spaces.Box(-np.inf, np.inf, (outputs,), np.float64)
        self.action_space = spaces.Box(-np.inf, np.inf, (inputs,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin an episode in the state `x0`."""
        super().reset(seed=seed)
        return self._seen(self._first + np.zeros(len(self._a)))

    def step(self, action: Floats) -> tuple[Floats, float, bool, bool, dict[str, Any]]:
        """Move the plant by one step with the input `action`."""
        x, u = self._x, np.asarray(action, float)
        if x is None:
            raise ResetNeeded("call reset() before step()")
        cost = x @ self._q @ x + u @ self._r @ u
        x = self._a @ x + self._b @ u + self._w @ self.np_random.standard_normal(len(x))
        seen, info = self._seen(x)
        is_over = bool(np.abs(x).max() > self._limit)
        return seen, -float(cost), is_over, False, info

    def _seen(self, x: Floats) -> tuple[Floats, dict[str, Any]]:
        """Move to the state `x`; return the outputs, and the state for the judge."""
        self._x = x
        seen = self._c @ x
        if self._is_noisy:
            seen = seen + self._v @ self.np_random.standard_normal(len(seen))
        return seen, {"x": x.copy()}


def _matrix(name: str, value: Any, shape: tuple[int | None, int | None]) -> Floats:
    """Return a matrix of a shape, in which None is any size; a number is a multiple of identity."""
    found = ANY.array(value, name).astype(float)
    if found.ndim == 0:
        known = max(size for size in shape if size is not None)
        found = found * np.eye(known)
    sizes = zip(found.shape, shape, strict=False)
    if found.ndim != 2 or any(size not in (have, None) for have, size in sizes):
        wanted = " x ".join("any" if size is None else str(size) for size in shape)
        raise InvalidValueError(f"{name} has the shape {found.shape}, not {wanted}")
    return found


def _root(name: str, covariance: Floats) -> Floats:
    """Return the root of a covariance: what white noise is multiplied with."""
    sizes, axes = np.linalg.eigh(covariance)
    if not np.allclose(covariance, covariance.T) or sizes.min() < -1e-12 * abs(sizes).max():
        raise InvalidValueError(f"{name} is no covariance: symmetric, with no negative eigenvalue")
    return np.asarray((axes * np.sqrt(np.maximum(sizes, 0.0))) @ axes.T)
