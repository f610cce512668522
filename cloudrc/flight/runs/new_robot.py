# SPDX-License-Identifier: Apache-2.0

"""Write the folder of a new robot: a description, a model and a test, which the user changes."""

from __future__ import annotations

from pathlib import Path

from cloudrc.base.files import write_atomically
from cloudrc.base.outside.paths import make_folder
from cloudrc.config import shipped

MODEL_OF = "x2"
"""Shipped robot whose model the new robot gets."""
DESCRIPTION = """\
description: My robot
model: robot.xml          # MJCF; the base has a free joint
onboard: multirotor       # or diff_drive, or ./onboard.py with a function build(model), or the name
                          # that a package gives in its entry point group cloudrc.onboard
# planar: true            # for a robot that stays on the ground
hull_m: 0.34              # ball about the base that holds the robot: at least size_m of the check
# sensors: {height: {unit: m, sensor: range}}            # own values, from sensors of the model
guard: {acceleration_max_mps2: 4, braking_mps2: 3}     # 'cloudrc robot check' measures the braking
# thrust_n_s2: 5.57e-6    # thrust of a rotor per squared speed, for the number rotor_energy
# response:               # for predictors; 'cloudrc identify RUN' fits it to a flight
#   time_constant: [0.2, 0.2, 0.1]
#   dead_time: [0.05, 0.05, 0.02]
#   gain: [1, 1, 1]
"""
TEST = '''\
"""Fly the robot of this folder in virtual time; run it with: pytest"""

from pathlib import Path

import cloudrc

ROBOT = str(Path(__file__).parent)


def test_the_robot_hovers():
    settings = {"world.robot": ROBOT, "world.scene": "empty"}
    assert cloudrc.fly("hover", settings).verdict == "success"
'''


def write_robot(folder: Path) -> list[str]:
    """Write the files of a new robot into a new `folder`; return their names."""
    make_folder(folder)
    model = (shipped.FOLDERS["robot"] / MODEL_OF / "robot.xml").read_text(encoding="utf-8")
    files = {
        shipped.ROBOT_FILE: DESCRIPTION,
        "robot.xml": model.replace(f'model="{MODEL_OF}"', 'model="my_robot"'),
        "test_robot.py": TEST,
    }
    for name, text in files.items():
        write_atomically(folder / name, text.encode())
    return list(files)
