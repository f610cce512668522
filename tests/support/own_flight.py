# SPDX-License-Identifier: Apache-2.0

"""A flight with files of one's own: robot, scene and predictor."""

import shutil

from cloudrc.config.load import load_experiment
from cloudrc.config.robot import find_robot
from cloudrc.config.shipped import file_of
from cloudrc.flight.fly import fly

PREDICTOR = "from cloudrc.cloud.predictors.last_sample import build\n"
GHOST = '<body name="ghost"><geom size=".1" contype="0" conaffinity="0"/></body>'
"""Body that nothing can touch."""


def fly_own(tmp_path_factory):
    """Fly the user's own rover; return the folders of the run and of the user's files."""
    files, folder = tmp_path_factory.mktemp("mine"), tmp_path_factory.mktemp("run")
    shutil.copytree(find_robot("rover").model.parent, files / "robot")
    scene = file_of("pillars").read_text().replace("</worldbody>", f"{GHOST}</worldbody>")
    (files / "scene.xml").write_text(scene)
    (files / "mine.py").write_text(PREDICTOR)
    sets = (
        f"world.robot={files / 'robot'}",
        f"world.scene={files / 'scene.xml'}",
        f"cloud.predictor={files / 'mine.py'}",
        "mission.waypoints=[{position_m: [0.1, 0], dwell_s: 0.0}]",
    )
    fly(load_experiment("pillars", sets), "virtual", folder, page=False)
    return folder, files
