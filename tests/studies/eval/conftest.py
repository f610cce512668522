# SPDX-License-Identifier: Apache-2.0

"""The file of a policy, which holds the pole of CartPole if a test gives no other."""

import pytest

LAW = """
import numpy as np

def decide(x, speed, angle, turn):
    return int(10.0 * angle + 2.0 * turn + 0.1 * x + 0.3 * speed > 0.0)

def infer(observation):
    return {"actions": [[decide(*observation["observation/state"])]] * 2}
"""


@pytest.fixture
def law(tmp_path):
    """Write the file of a policy; return its path."""

    def write(source=LAW):
        path = tmp_path / "law.py"
        path.write_text(source)
        return str(path)

    return write


@pytest.fixture
def evaluate(call):
    """Return a function that runs `cloudrc eval`, checks its exit code, and returns its output."""
    return lambda *words, code=0: call("eval --env CartPole-v1 --jobs 1", *words, code=code)


@pytest.fixture(autouse=True)
def no_figures(monkeypatch):
    """Draw no figures, which takes seconds; a test of them begins with `monkeypatch.undo()`."""
    for name in ("draw_outcomes", "draw_ages"):
        monkeypatch.setattr(f"cloudrc.studies.eval.page.{name}", lambda *_: {"svg": b"<svg/>"})
