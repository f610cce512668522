# SPDX-License-Identifier: Apache-2.0

"""Write the files of a robot or of a plug-in of one's own: one that flies, and a test of it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from cloudrc.base.errors import BadInputError
from cloudrc.base.files import write_atomically
from cloudrc.base.outside.paths import make_folder

TEMPLATES = Path(__file__).with_name("templates")
MODEL_OF = "x2"
"""Shipped robot whose model a new robot gets."""


class New(NamedTuple):
    """What can be written."""

    about: str  # line in the help
    template: str  # stem of its file in `TEMPLATES`, and of its test
    changes: str  # what the user changes in it
    command: str  # how to fly with it; {path} is what was written


NEW = {
    "robot": New(
        "a folder with a robot: robot.yaml, robot.xml and a test",
        "robot",
        "robot.yaml and robot.xml",
        "cloudrc run steps --mode virtual --set world.robot={path}",
    ),
    "predictor": New(
        "a predictor: where the robot will be when a command acts",
        "predictor",
        "predict()",
        "cloudrc run steps --mode virtual --set link.profile=lte --set cloud.predictor={path}",
    ),
    "estimator": New(
        "an estimator: how far ahead a predictor predicts",
        "estimator",
        "update() and horizon()",
        "cloudrc run steps --mode virtual --set link.profile=lte --set cloud.estimator={path}",
    ),
    "controller": New(
        "a controller: from the predicted state to a velocity",
        "controller",
        "update()",
        "cloudrc run steps --mode virtual --set link.profile=lte --set cloud.controller={path}",
    ),
    "perception": New(
        "a perception: from a scan or a picture to a setpoint",
        "perception",
        "see()",
        "cloudrc run gap --mode virtual --set cloud.perception={path}",
    ),
    "metric": New(
        "a metric: one number of a flight",
        "metric",
        "measure()",
        "cloudrc run steps --mode virtual --set report.metrics={path}",
    ),
    "executor": New(
        "an executor: the action of each step, from chunks that are late",
        "executor",
        "action()",
        "cloudrc eval --env CartPole-v1 --policy ./policy.py --link lte --executor {path}",
    ),
}
"""Kind, as it is typed -> what can be written."""
OF_CAMERA = New(
    "a perception of a robot with a camera",
    "perception_camera",
    "see()",
    "cloudrc run follow --mode virtual --set cloud.perception={path}",
)
"""What `--camera` writes in place of a perception of scans."""


def write(new: New, path: Path) -> list[Path]:
    """Write the files of a robot into the new folder `path`, or a plug-in to `path` and its test.

    Return the paths of the files; the last one is the test.

    Raises:
        BadInputError: If a file is there already, or `path` is no name of a Python module.
    """
    texts = _robot(path) if new is NEW["robot"] else _plugin(new, path)
    for file, text in texts.items():
        write_atomically(file, text.encode())
    return [*texts]


def _robot(folder: Path) -> dict[Path, str]:
    from cloudrc.config import shipped  # it loads YAML, which no other kind needs

    make_folder(folder)
    model = (shipped.FOLDERS["robot"] / MODEL_OF / "robot.xml").read_text(encoding="utf-8")
    return {
        folder / shipped.ROBOT_FILE: (TEMPLATES / "robot.yaml").read_text(encoding="utf-8"),
        folder / "robot.xml": model.replace(f'model="{MODEL_OF}"', 'model="my_robot"'),
        folder / "test_robot.py": _source("test_robot"),
    }


def _plugin(new: New, file: Path) -> dict[Path, str]:
    if file.suffix != ".py":
        raise BadInputError(f"{file}: name a Python file, such as {file}.py")
    if not file.stem.isidentifier():
        text = "its name is no identifier of Python: letters, digits and _, as in my_plugin.py"
        raise BadInputError(f"{file}: {text}")
    test = file.with_name(f"test_{file.name}")
    for each in (file, test):
        if each.exists():
            raise BadInputError(f"{each}: exists already; name another file")
    tests = _source(f"test_{new.template}").replace(f'"{new.template}.py"', f'"{file.name}"')
    return {file: _source(new.template), test: tests}


def _source(stem: str) -> str:
    """Return a template without the line of its licence: the user's file has the user's."""
    return (TEMPLATES / f"{stem}.py").read_text(encoding="utf-8").partition("\n\n")[2]
