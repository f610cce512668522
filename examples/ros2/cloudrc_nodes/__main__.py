# SPDX-License-Identifier: Apache-2.0

"""Run nodes in one process: python -m cloudrc_nodes [NODE ...]; without a name, all of them.

What is not named stays built into cloudrc.
"""

from __future__ import annotations

import sys
from functools import partial

from rclpy.utilities import remove_ros_args

from cloudrc_nodes import remaps
from cloudrc_nodes.controller import Controller
from cloudrc_nodes.estimator import Estimator
from cloudrc_nodes.pairs import run
from cloudrc_nodes.predictor import Predictor
from cloudrc_nodes.teleop import Teleop

NODES = {
    "estimator": Estimator,
    "predictor": Predictor,
    "teleop": Teleop,
    "controller": Controller,
}

names = remove_ros_args(sys.argv)[1:] or list(NODES)
if unknown := set(names) - set(NODES):
    sys.exit(f"no node {', '.join(sorted(unknown))}; there are {', '.join(NODES)}")
rules = {
    name: [word for rule in remaps(name, names) for word in ("-r", ":=".join(rule))]
    for name in names
}
run(*(partial(NODES[name], cli_args=["--ros-args", *rules[name]]) for name in names))
