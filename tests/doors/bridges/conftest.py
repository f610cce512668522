# SPDX-License-Identifier: Apache-2.0

"""What the tests with a real ROS 2 share: `make ros2-test` runs them."""

import os
from importlib.util import find_spec
from pathlib import Path

import pytest

needs_ros = [
    pytest.mark.ros2,
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),  # of ROS's own packages
    pytest.mark.skipif(find_spec("rclpy") is None, reason="needs a sourced ROS 2: make ros2-test"),
]


@pytest.fixture(autouse=True)
def own_domain(monkeypatch):
    """Keep the tests apart from other nodes of this machine."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.chdir(Path(__file__).parents[3])  # nodes of the tests are modules of it
