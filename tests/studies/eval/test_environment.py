# SPDX-License-Identifier: Apache-2.0

"""An episode of changed files is another episode: its key differs."""

import sys
from pathlib import Path

import gymnasium
import pytest

from cloudrc.doors.cli.eval_values import read_compute
from cloudrc.studies.eval.environment import environment_code
from cloudrc.studies.eval.episode import make_env
from cloudrc.studies.eval.setup import Episode, EvalSetup

FILES = {
    "law.py": "from gains import GAIN\ndef infer(observation):\n    return {'actions': [[GAIN]]}\n",
    "gains.py": "GAIN = 0.0\n",
    "hold.py": "import waits\nfrom cloudrc.gym.executors.newest import Newest\nbuild = Newest\n",
    "waits.py": "",
    "link.yaml": (
        "uplink: {trace: t.csv}\ndownlink:\n  jitter_ms: 2\n  distribution: table\n  table: d.csv\n"
    ),
    "t.csv": "time_s,delay_ms\n0,10\n1,20\n",
    "d.csv": "time_s,delay_ms\n0,1\n1,2\n2,4\n",
    "times.csv": "step,compute_s\n0,0.1\n",
    "scene.txt": "a",
    "other.txt": "a",
    "site-packages/parts/__init__.py": "from gymnasium import Env\nclass Part(Env):\n  dt = 0.1\n",
    "libs/rewards.py": "REWARD = 0.1\n",
    "tools/makes_arms.py": "import gymnasium\ngymnasium.register('Arm-v0', 'arms.arm:make')\n",
    "tools/arms/__init__.py": "",
    "tools/arms/arm.py": "from arms.sizes import SIZE\nfrom .robot import Arm as make\n",
    "tools/arms/sizes.py": "SIZE = 2\n",
    "tools/arms/robot.py": """
import gymnasium
import numpy as np
import parts
from rewards import REWARD

class Arm(parts.Part):
    action_space = observation_space = gymnasium.spaces.Box(-1, 1, (1,))

    def __init__(self, files=()):
        pass

    def reset(self, *, seed=None, options=None):
        return np.zeros(1), {}

    def step(self, action):
        return np.zeros(1), REWARD, True, False, {}
""",
}
"""Path -> content of files that each decide what happens in an episode."""
CHANGES = {".csv": "3,9\n", ".yaml": "  delay_ms: 1\n"}
"""Suffix of a file -> what changes its meaning at the end."""
ENV = "makes_arms:Arm-v0"


@pytest.fixture
def folder(tmp_path, monkeypatch):
    for name, text in FILES.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    monkeypatch.chdir(tmp_path)
    for name in ("site-packages", "libs", "tools"):
        monkeypatch.syspath_prepend(tmp_path / name)
    yield tmp_path
    for name in [each for each in sys.modules if each.partition(".")[0] in ("arms", "parts")]:
        del sys.modules[name]
    for name in ("rewards", "makes_arms"):
        sys.modules.pop(name, None)
    gymnasium.registry.pop("Arm-v0", None)


def key_of_all():
    files = (("files", ["scene.txt", {"more": "other.txt"}]),)
    setup = EvalSetup(ENV, "./law.py", files, "./link.yaml", *read_compute("times.csv"))
    with make_env(setup, 1) as env:
        told = {**setup.identity(), "env_code": environment_code(env, setup)}
    return Episode(None, "./hold.py", 1).key(told)


def test_an_episode_of_a_changed_file_is_another(folder):
    before, unseen = key_of_all(), []
    (folder / "unused.py").touch()
    for name, text in FILES.items():
        if "site-packages" in name:  # the version of an installed package counts
            continue
        (folder / name).write_text(text + CHANGES.get(Path(name).suffix, "\n"))
        if key_of_all() == before:
            unseen.append(name)
        (folder / name).write_text(text)
    assert unseen == []
    assert key_of_all() == before
