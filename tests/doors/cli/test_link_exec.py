# SPDX-License-Identifier: Apache-2.0

"""`cloudrc link exec`: what it says before the programs start."""

import pytest

from cloudrc.base.errors import StateError
from cloudrc.flight.links import programs


@pytest.mark.parametrize("place", ["environment", "command"])
def test_a_setting_that_hides_nodes_of_ros_from_each_other_is_named(place, call, monkeypatch):
    def stop(*arguments):
        raise StateError("no programs here")

    monkeypatch.setattr(programs, "run_programs", stop)
    name, value = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
    client = f"{name}={value} talker" if place == "command" else "talker"
    monkeypatch.setenv(name, value if place == "environment" else "SUBNET")
    flags = "link exec --link ideal --server listener --client"
    error = call(flags, client, code=StateError.exit_code).err
    assert f"warning: {name}={value}: nodes of ROS 2 at the two ends do not find" in error
