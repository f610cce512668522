# SPDX-License-Identifier: Apache-2.0

"""Build the package with colcon."""

from setuptools import setup

NODES = ("estimator", "predictor", "teleop", "controller")

setup(
    name="cloudrc_nodes",
    version="0.1.0",
    packages=["cloudrc_nodes"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/cloudrc_nodes"]),
        ("share/cloudrc_nodes", ["package.xml"]),
        ("share/cloudrc_nodes/launch", ["launch/paper.launch.py", "launch/robot.launch.py"]),
    ],
    install_requires=["setuptools"],
    entry_points={"console_scripts": [f"{name} = cloudrc_nodes.{name}:main" for name in NODES]},
)
