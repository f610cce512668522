# SPDX-License-Identifier: Apache-2.0

"""Environments of a user: where they lie, what their arguments are, what they return."""

import json
import sys
from pathlib import Path

import pytest

from cloudrc.base.errors import BadInputError
from cloudrc.studies.eval.episode import check_environment
from cloudrc.studies.eval.setup import EvalSetup
from tests.conftest import nightly_rows

STILL = "def infer(observation):\n    return {'actions': [[0.0]]}\n"


MY_ENV = """
import gymnasium
import numpy as np

class My(gymnasium.Env):
    dt, control_hz = 0.05, 20
    action_space = gymnasium.spaces.Box(-1, 1, (1,))
    observation_space = gymnasium.spaces.Box(-1, 1, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.float32), {}

    def step(self, action):
        import NAME_sizes  # late, from beside
        return np.zeros(2, np.float32), 1.0, True, False, {}

gymnasium.register("ID", entry_point=My)
"""


@pytest.mark.parametrize(
    ("place", "module", "name", "env", "jobs"),
    [
        ("laws", "beside_env", "Beside-v0", "beside_env:Beside-v0", 1),
        *nightly_rows(
            ("laws", "two_env", "Two-v0", "two_env:Two-v0", 2),
            ("elsewhere", "else_env", "space/Else-v0", "elsewhere/else_env.py:space/Else-v0", 2),
        ),
    ],
)
def test_an_environment_may_be_a_file_here_or_beside_the_policy(
    tmp_path, monkeypatch, call, place, module, name, env, jobs
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    for folder in {"laws", place}:
        Path(folder).mkdir()
    Path("laws/law.py").write_text(STILL)
    Path(place, f"{module}.py").write_text(MY_ENV.replace("NAME", module).replace("ID", name))
    Path(place, f"{module}_sizes.py").touch()
    said = call(f"eval --env {env} --policy laws/law.py --seeds 2 --jobs {jobs}")
    assert "4 episodes, step 0.05 s (control_hz of My)" in said.err
    (folder,) = (each for each in Path("runs").iterdir() if not each.is_symlink())
    assert ":" not in folder.name
    told = json.loads((folder / "eval.json").read_text())
    assert told["step"] == {"seconds": 0.05, "source": "control_hz of My"}
    assert "step 0.05 s (control_hz of My)" in (folder / "report.html").read_text()


def test_an_unknown_environment_is_one_line_with_the_way_to_name_ones_own(law):
    words = "--env Point-v0: .*Point.*if a module of your own registers it: MODULE:Point-v0"
    with pytest.raises(BadInputError, match=words) as caught:
        check_environment(EvalSetup("Point-v0", law(STILL)), [])
    assert "\n" not in str(caught.value)
